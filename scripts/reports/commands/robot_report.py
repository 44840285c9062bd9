"""Measure robots: identification, tracking, learned kinematics, real logs and speed, beside rivals in the same run.

Prints one table (case, quantity, expected, value, unit, reference, to reach, pass) and writes report.json. Rivals are
measured where they are installed: pip install 'dln-jax[reference]'. Recordings are measured where they are given. Only
`speed` depends on the machine.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from dln_jax.cli.arguments import Unstated, choice, names_in
from dln_jax.cli.options import Folder
from dln_jax.precision import in_float64
from dln_jax.types import InputError
from scripts.reports.case import Case, Findings, in_subjects, report_cases
from scripts.reports.encoder_data import encoders
from scripts.reports.excitation import excitation
from scripts.reports.robots import (
    arrival_and_repeats,
    double_pendulum,
    identified_by,
    kinds_of_logs,
    known_kinematics,
    lip,
    log_checks,
    speed,
)
from scripts.reports.robots.added_terms import added_terms
from scripts.reports.robots.recorded_arm import recorded_arm

MEASURES: dict[str, Callable[[bool], Findings]] = {
    "arm/clean": known_kinematics.clean,
    "arm/noisy": known_kinematics.noisy,
    "learned/seven-joints": lip.seven_joints,
    "learned/fewer-joints": lip.fewer_joints,
    "learned/fewer-samples": lip.fewer_samples,
    "learned/kernels": lip.kernels,
    "preparation/encoders": encoders,
    "preparation/excitation": excitation,
    "logs/sound": partial(log_checks.sound, with_robot=False),
    **{f"logs/{kind}": partial(log_checks.faulty, kind=kind) for kind in log_checks.FAULTS},
    "logs/sound-with-robot": partial(log_checks.sound, with_robot=True),
    **{f"logs/sound-{kind}": partial(kinds_of_logs.sound, recording=kind) for kind in kinds_of_logs.RECORDINGS},
    **{f"logs/{kind}": partial(kinds_of_logs.faulty, kind=kind) for kind in kinds_of_logs.FAULTS},
    "logs/arrival": arrival_and_repeats.arrival,
    "logs/repeated-motions": arrival_and_repeats.repeated_motions,
    "terms/two-joints": added_terms,
    "speed/seven-axis": speed.speed,
}
"""Functions quick -> findings, by SUBJECT/NAME."""
SUBJECTS = (*dict.fromkeys(name.split("/")[0] for name in MEASURES), "recordings")


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


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    subjects = names_in("--only", options.only, SUBJECTS)
    if (options.log is None) != (options.robot is None):
        raise InputError("--log and --robot belong together; give both, or neither")
    for path in (options.log, options.robot, options.double_pendulum):
        if path is not None and not path.is_file():
            raise InputError(f"{path}: no such file")
    chosen = in_subjects(cases(options), subjects)
    if not chosen:
        raise InputError("--only recordings without any; give --log and --robot, or --double-pendulum")
    report_cases(options, "robots", chosen, dtype="float64")


def cases(options: Arguments = Arguments()) -> list[Case]:
    """All cases, in float64; recordings are left out without their files."""
    measures = dict(MEASURES)
    if options.log is not None and options.robot is not None:
        measures["recordings/arm"] = partial(recorded_arm, options.log, options.robot)
    if (pendulum := options.double_pendulum) is not None:
        splits = double_pendulum.HELD_OUT[: 1 if options.quick else None]
        measures["recordings/double-pendulum"] = lambda quick: Findings(double_pendulum.rows(pendulum, splits))
        measures["recordings/identify-by"] = lambda quick: Findings(identified_by.rows(pendulum, splits))
    return [Case(name, in_float64(partial(measure, options.quick))) for name, measure in measures.items()]
