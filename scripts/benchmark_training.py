"""benchmark training: error against seconds for every model of the arm, by Gauss-Newton and by Adam."""

from matplotlib.figure import Figure

from dln_jax.evaluation.figures import error_against_time
from dln_jax.evaluation.report import Row
from scripts.arm_models import SIZES, measure_adam, measure_seeds, measure_trigonometric
from scripts.arm_table import letters

ADAM_STEPS = 20_000


def measure(quick: bool) -> tuple[list[Row], Figure]:
    """One seed of each on the embedded letters; the arm's table has medians of several."""
    sets = letters(None)
    jobs = {"trigonometric/letters": lambda: measure_trigonometric(sets)}
    for kind in ("structured-delan",) if quick else SIZES:
        jobs[f"{kind}/letters/gauss-newton"] = lambda kind=kind: measure_seeds(
            kind, sets, seeds=1, steps=30 if quick else None
        )
        jobs[f"{kind}/letters/adam"] = lambda kind=kind: measure_adam(kind, sets, steps=1_000 if quick else ADAM_STEPS)
    rows, lines = [], {}
    for case, job in jobs.items():
        numbers, curve = job()
        rows += [
            Row(case, "torque_mse", numbers["torque_mse"], "N^2 m^2"),
            Row(case, "train_seconds", numbers["train_seconds"], "s"),
        ]
        if curve is not None:
            lines[case] = (curve.seconds, curve.errors)
    return rows, error_against_time(lines)
