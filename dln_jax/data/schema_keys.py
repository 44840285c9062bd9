"""Keys of the schema, by shape."""

RATES = ("qd", "qdd")
OPTIONAL = ("tau", "p", "pd", "tau_inertial", "tau_coriolis", "tau_gravity")
PER_JOINT = ("q", *RATES, *OPTIONAL, "temperature")
KEYS = ("t", *PER_JOINT, "trajectory", "label", "joint_names", "needs")
