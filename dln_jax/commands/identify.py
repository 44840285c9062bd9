"""Identify a robot from its URDF or MJCF file and a log of q, qd, qdd and tau.

Finds base parameters with standard errors, friction, and physically consistent parameters, and states what the data do
not determine. A run folder gets config.json, metrics.json, the model (load it with dln_jax.load, or export it to C),
report.txt and parameters.json, the robot's file with the identified values, and figures. Held-out trajectories judge
the result, or blocks of time if there is only one trajectory.
"""

from dln_jax.training.identification.options import Options as Arguments


def main(options: Arguments) -> None:
    """Identifies the robot, evaluates the model and writes the run folder."""
    from dln_jax.training.identification.run import IDENTIFICATION
    from dln_jax.training.pipeline import train

    train(IDENTIFICATION, options, "identify")
