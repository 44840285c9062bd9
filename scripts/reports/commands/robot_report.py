"""Measure robots: identification, tracking, learned kinematics, real logs and speed, beside rivals in the same run.

Prints one table (case, quantity, expected, value, unit, reference, to reach, pass) and writes report.json. Rivals are
measured where they are installed: pip install 'dln-jax[reference]'. Recordings are measured where they are given.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from dln_jax.cli.arguments import Unstated, choice, names_in
from dln_jax.cli.options import Folder
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.types import InputError
from scripts.reports.case import measure_and_publish
from scripts.reports.robots import MEASURES, cases

SUBJECTS = (*MEASURES, "recordings")


@dataclass(frozen=True)
class Arguments(Folder):
    """What to measure."""

    only: Annotated[str, choice(SUBJECTS, several=True)] = ",".join(SUBJECTS)
    """Subjects (default: all)."""
    log: Unstated[Path] = None
    """Recording of an arm, an npz with t, q, tau and joint_names; with --robot."""
    robot: Unstated[Path] = None
    """Its URDF or MJCF file."""
    double_pendulum: Unstated[Path] = None
    """Recordings of a double pendulum, an npz with t, q, tau and trajectory."""
    quick: bool = False
    """Fewer seeds and motions."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    subjects = names_in("--only", given.only, SUBJECTS)
    if (given.log is None) != (given.robot is None):
        raise InputError("--log and --robot belong together; give both, or neither")
    for path in (given.log, given.robot, given.double_pendulum):
        if path is not None and not path.is_file():
            raise InputError(f"{path}: no such file")
    found = cases(quick=given.quick, log=given.log, robot=given.robot, pendulum=given.double_pendulum)
    chosen = [case for each in subjects for case in found if case.name.startswith(f"{each}/")]
    if not chosen:
        raise InputError("--only recordings without any; give --log and --robot, or --double-pendulum")
    with command_folder(given, "robots") as folder:
        measure_and_publish(folder, chosen, dtype="float64", quick=given.quick)
