"""benchmark softbody: steps per second of soft bodies, their gradients, and speed against error of the integrators."""

from matplotlib.figure import Figure

from dln_jax.figures.benchmarks import cost_curves
from dln_jax.studies import soft_bodies
from dln_jax.studies.case import Findings, named
from dln_jax.studies.soft_bodies.figures import speed_against_error
from dln_jax.studies.soft_bodies.speed import LANES


def measure(quick: bool) -> Findings:
    """The speeds of `softbody_report`; the table of linear solvers is left to that."""
    names = ("creature",) if quick else ("creature", "beams", "backward", "speed-against-error")
    found = [case.measure() for case in named(soft_bodies.cases(quick=quick), *(f"speed/{name}" for name in names))]
    rows = [row._replace(case=row.case.removeprefix("speed/"), expected="") for each in found for row in each.rows]
    rates = [row.value for row in rows if row.quantity.endswith("steps_per_second")]
    return Findings(rows, {"crawler": ([1, LANES], rates)} if quick else found[-1].curves)


def draw(lines: dict) -> Figure:
    """Speed against error, or if quick against the number of lanes."""
    if "crawler" in lines:
        return cost_curves(lines, x="lanes", y="steps per second", title="28 vertices, float64")
    return speed_against_error(lines)
