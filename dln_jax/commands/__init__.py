"""The commands, one file each: `dln-jax NAME`."""

COMMANDS = [
    *("check_data", "excite", "make_data", "identify", "train_delan", "train_hnn", "train_hnn_task"),
    *("train_hnn_pixels", "train_diffnet", "evaluate", "swing_up", "train_value", "simulate", "train_locomotion"),
    *("evaluate_locomotion", "sweep", "export_c"),
]
"""Names of the commands, in the order of a project: data, models, control, soft bodies, sweeps, deployment."""
