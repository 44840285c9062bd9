"""Measurements of robots: identification, tracking, learned kinematics, real logs and speed."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from dln_jax.precision import in_float64
from scripts.reports.case import Case, Findings
from scripts.reports.figures.robots import errors_by_arm, errors_by_joint
from scripts.reports.robots import (
    before_fitting,
    double_pendulum,
    known_kinematics,
    learned_kinematics,
    log_checks,
    speed,
)
from scripts.reports.robots.recorded_arm import recorded_arm

MEASURES: dict[str, dict[str, Callable[[bool], Findings]]] = {
    "arm": {"clean": known_kinematics.clean, "noisy": known_kinematics.noisy},
    "learned": {
        "seven-joints": learned_kinematics.seven_joints,
        "fewer-joints": learned_kinematics.fewer_joints,
        "fewer-samples": learned_kinematics.fewer_samples,
        "kernels": learned_kinematics.kernels,
        "unknown-trees": learned_kinematics.unknown_trees,
    },
    "preparation": {"encoders": before_fitting.encoders, "excitation": before_fitting.excitation},
    "logs": {
        "sound": functools.partial(log_checks.sound, with_robot=False),
        **{kind: functools.partial(log_checks.faulty, kind=kind) for kind in log_checks.FAULTS},
        "sound-with-robot": functools.partial(log_checks.sound, with_robot=True),
    },
    "speed": {"seven-axis": speed.speed},
}
"""Functions quick -> findings, by subject and name; only `speed` depends on the machine."""
DRAWN: dict[str, Callable[[dict[str, Any]], Figure]] = {
    "arm/noisy": errors_by_joint,
    "recordings/arm": errors_by_joint,
    **dict.fromkeys((f"learned/{name}" for name in MEASURES["learned"]), errors_by_arm),
}
"""Functions that draw the curves of cases."""


def cases(
    *, quick: bool = False, log: Path | None = None, robot: Path | None = None, pendulum: Path | None = None
) -> list[Case]:
    """All cases, named SUBJECT/NAME, in float64; quick ones have fewer seeds and motions.

    Args:
        quick: smaller measurements.
        log, robot: log of a recorded arm and its URDF or MJCF file; without them the case is left out.
        pendulum: recordings of a double pendulum; without them the case is left out.
    """
    measures = {f"{subject}/{name}": measure for subject, named in MEASURES.items() for name, measure in named.items()}
    if log is not None and robot is not None:
        measures["recordings/arm"] = functools.partial(recorded_arm, log, robot)
    if pendulum is not None:
        splits = double_pendulum.HELD_OUT
        measures["recordings/double-pendulum"] = lambda quick: Findings(
            double_pendulum.rows(pendulum, splits[:1] if quick else splits)
        )
    return [
        Case(name, in_float64(functools.partial(measure, quick)), draw=DRAWN.get(name))
        for name, measure in measures.items()
    ]
