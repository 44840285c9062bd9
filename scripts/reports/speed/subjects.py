"""Speed against error: single calls, batches, training, integrators, precision, soft bodies, exported C."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

from matplotlib.figure import Figure

from scripts.reports import soft_bodies
from scripts.reports.case import Case, Findings, named
from scripts.reports.figures.costs import cost_curves, error_against_time
from scripts.reports.soft_bodies.figures import speed_against_error
from scripts.reports.soft_bodies.speed import LANES
from scripts.reports.speed import costs, exported_c, integrators, one_step, precision, training

__all__ = ["SUBJECTS", "cases"]


def measure_soft_bodies(quick: bool) -> Findings:
    """The speeds of `softbody_report`; the table of linear solvers is left to that."""
    names = ("creature",) if quick else ("creature", "beams", "backward", "speed-against-error")
    found = [case.measure() for case in named(soft_bodies.cases(quick=quick), *(f"speed/{name}" for name in names))]
    rows = [row._replace(case=row.case.removeprefix("speed/"), expected="") for each in found for row in each.rows]
    rates = [row.value for row in rows if row.quantity.endswith("steps_per_second")]
    return Findings(rows, {"crawler": ([1, LANES], rates)} if quick else found[-1].curves)


def draw_soft_bodies(lines: dict[str, Any]) -> Figure:
    """Speed against error, or if quick against the number of lanes."""
    if "crawler" in lines:
        return cost_curves(lines, x="lanes", y="steps per second", title="28 vertices, float64")
    return speed_against_error(lines)


SUBJECTS: dict[str, tuple[Callable[..., Findings], Callable[[dict[str, Any]], Figure]]] = {
    "one-step": (one_step.measure, one_step.draw),
    "throughput": (costs.measure_throughput, costs.draw_throughput),
    "scaling": (costs.measure_scaling, costs.draw_scaling),
    "training": (training.measure, error_against_time),
    "integrators": (integrators.measure, integrators.draw),
    "precision": (precision.measure, precision.draw),
    "softbody": (measure_soft_bodies, draw_soft_bodies),
    "c": (exported_c.measure, exported_c.draw),
}
"""Functions that measure (quick -> findings) and draw the subjects."""


def cases(*, quick: bool = False, **options: Mapping[str, Any]) -> list[Case]:
    """All subjects; their rows are named SUBJECT/..., and quick ones have fewer of them and fewer repetitions.

    `options` are more keywords of what measures, by subject.
    """
    return [
        Case(name, functools.partial(_measured, name, quick, options.get(name, {})), draw=draw)
        for name, (_, draw) in SUBJECTS.items()
    ]


def _measured(name: str, quick: bool, options: Mapping[str, Any]) -> Findings:
    found = SUBJECTS[name][0](quick, **options)
    return found._replace(rows=[row._replace(case=f"{name}/{row.case}") for row in found.rows])
