"""Speed against error: single calls, batches, training, integrators, precision, soft bodies."""

import functools
from collections.abc import Callable
from typing import Any

from matplotlib.figure import Figure

from dln_jax.studies.case import Case, Findings
from dln_jax.studies.speed import integrators, one_step, precision, scaling, soft_bodies, throughput, training

__all__ = ["SUBJECTS", "cases"]

SUBJECTS: dict[str, tuple[Callable[[bool], Findings], Callable[[dict[str, Any]], Figure]]] = {
    "one-step": (one_step.measure, one_step.draw),
    "throughput": (throughput.measure, throughput.draw),
    "scaling": (scaling.measure, scaling.draw),
    "training": (training.measure, training.draw),
    "integrators": (integrators.measure, integrators.draw),
    "precision": (precision.measure, precision.draw),
    "softbody": (soft_bodies.measure, soft_bodies.draw),
}
"""What measures each, by quick, and what draws it."""


def cases(*, quick: bool = False) -> list[Case]:
    """All subjects; their rows are named SUBJECT/..., and quick ones have fewer of them and fewer repetitions."""
    return [Case(name, functools.partial(_measured, name, quick), draw=draw) for name, (_, draw) in SUBJECTS.items()]


def _measured(name: str, quick: bool) -> Findings:
    found = SUBJECTS[name][0](quick)
    return found._replace(rows=[row._replace(case=f"{name}/{row.case}") for row in found.rows])
