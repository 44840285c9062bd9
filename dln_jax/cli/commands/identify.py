"""Identify a robot from its URDF or MJCF file and a log of q, qd, qdd and tau.

Base parameters and their standard errors, what the data do not show, friction, and physically consistent parameters. A
run folder gets config.json, metrics.json, the model (load it with dln_jax.load, or export it to C), report.txt and
parameters.json, the robot's file with the identified values, and figures. Judged by held-out trajectories, or by blocks
of time where there is one trajectory only.
"""

from dln_jax.training.identification.options import Options as Arguments


def main(options: Arguments) -> None:
    """Identifies the robot, evaluates the model and writes the run folder."""
    from dln_jax.training.identification.run import IDENTIFICATION
    from dln_jax.training.pipeline import train

    train(IDENTIFICATION, options, "identify")
