"""Identify a robot from its URDF or MJCF file and a log of q, qd, qdd and tau.

Base parameters and their standard errors, what the data do not show, friction, and bodies that exist. A run folder gets
config.json, metrics.json, the model (load it with dln_jax.load, or export it to C), report.txt and parameters.json, the
robot's file with the identified values, and figures. Judged by held-out trajectories, or by blocks of time where there
is one trajectory only.
"""

from dataclasses import dataclass

from dln_jax.training.identification.run import run
from dln_jax.training.identification.task import Options


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Robot, data and method of identification."""


def main(given: Arguments) -> None:
    """Identifies the robot, evaluates the model and writes the run folder."""
    run(given, "identify")
