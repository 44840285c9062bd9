"""Validate a log before training: what is wrong with it, and what to do about it.

Checks sampling times, units, signs, qd and qdd against q, the delay between q and tau, saturation, encoder steps,
noise, joints that hardly move, and friction; with --robot also gravity, gears, the order and limits of joints, and how
well the motions determine the robot's parameters. Prints a report and writes it as report.txt, the findings as
findings.json, and a figure: spectra and cut-off, delay, and torque against velocity. The exit status is 1 if there are
errors, and 0 if there are only warnings and notes.
"""

from dataclasses import dataclass
from pathlib import Path

from dln_jax.options import Unstated
from dln_jax.runs.options import Drawn, Folder, Logged


@dataclass(frozen=True, kw_only=True)
class Arguments(Folder, Drawn, Logged):
    """The log to validate."""

    data: Path
    """Log as npz, CSV or ROS bag: t and q, and optionally tau, qd, qdd and trajectory."""
    robot: Unstated[Path] = None
    """URDF or MJCF of the robot (needs MuJoCo)."""
    lock: Unstated[str] = None
    """Joints of the robot to lock, such as those of a gripper, separated by commas; "*finger*" stands for all names
    that contain finger (default: all move)."""


def main(options: Arguments) -> None:
    """Examines the log, prints and writes the findings; exits with status 1 if there is an error among them."""
    from dln_jax.training.log_validation import validate

    validate(options)
