"""benchmark softbody: steps per second of soft bodies, their gradients, and speed against error of the integrators."""

from matplotlib.figure import Figure

from dln_jax.figures.benchmarks import curves
from dln_jax.studies.report import Row
from dln_jax.studies.soft_bodies import measure as measure_cases
from dln_jax.studies.soft_bodies.figures import FIGURES
from dln_jax.studies.soft_bodies.speed import LANES

AGAINST_ERROR = "speed-against-error"


def measure(quick: bool) -> tuple[list[Row], Figure]:
    """The speeds of `softbody_report`; the table of linear solvers is left to that."""
    names = ("creature",) if quick else ("creature", "beams", "backward", AGAINST_ERROR)
    found = {name: measure_cases("speed", name, quick=quick) for name in names}
    rows = [case.row._replace(case=case.name.removeprefix("speed/")) for each in found.values() for case in each.cases]
    if not quick:
        return rows, FIGURES[AGAINST_ERROR](found[AGAINST_ERROR].curves)
    rates = [row.value for row in rows if row.quantity.endswith("steps_per_second")]
    return rows, curves({"crawler": ([1, LANES], rates)}, x="lanes", y="steps per second", title="28 vertices, float64")
