"""benchmark training: error against seconds for every model of the arm, by Gauss-Newton and by Adam."""

from collections.abc import Callable
from functools import partial

from dln_jax.data.splits import Split
from dln_jax.learning.dynamics import problem
from dln_jax.learning.engine.fit import fit
from dln_jax.mechanics.equations import dynamics
from scripts.reports.arm.models import (
    WIDTHS,
    Measured,
    curve,
    end_of,
    linear_fit,
    measure_adam,
    measure_seeds,
    measure_trigonometric,
    prepared,
    torque_mse,
)
from scripts.reports.arm.table import letters, published_split
from scripts.reports.case import Findings
from scripts.reports.rows import Row

ADAM_STEPS = 20_000
QUICK = "structured-delan"
UNITS = {"torque_mse": "N^2 m^2", "train_seconds": "s"}


def measure(quick: bool) -> Findings:
    """Trains one seed of every model on the embedded letters; the arm's table has medians over several seeds."""
    sets = published_split(letters(None))
    linear = linear_alone if quick else measure_trigonometric
    jobs: dict[str, Callable[[], Measured]] = {"trigonometric/letters": partial(linear, sets)}
    if quick:
        jobs[f"{QUICK}/letters/gauss-newton"] = partial(gauss_newton_alone, sets, steps=20)
    for kind in () if quick else WIDTHS:
        jobs[f"{kind}/letters/gauss-newton"] = partial(measure_seeds, kind, sets, seeds=1, steps=None)
        jobs[f"{kind}/letters/adam"] = partial(measure_adam, kind, sets, steps=ADAM_STEPS)
    rows, lines = [], {}
    for case, job in jobs.items():
        numbers, path = job()
        rows += [Row(case, name, numbers[name], unit) for name, unit in UNITS.items()]
        lines[case] = (path["seconds"], path["errors"])
    return Findings(rows, lines)


def linear_alone(sets: Split) -> Measured:
    """The linear fit, without the rollouts and latencies of the arm's table, which take far longer."""
    fitted, energies = linear_fit(sets.train)
    numbers = {"torque_mse": torque_mse(dynamics(energies), sets.test), "train_seconds": fitted.seconds}
    return numbers, end_of(numbers)


def gauss_newton_alone(sets: Split, *, steps: int) -> Measured:
    """A few steps of a small network, likewise."""
    model, optimiser = prepared(QUICK, sets, steps=steps, width=4, depth=1)
    training = fit(problem(model, sets), optimiser)
    error = torque_mse(dynamics(model.energies(training.parameters)), sets.test)
    numbers = {"torque_mse": error, "train_seconds": training.compile_seconds + training.train_seconds}
    return numbers, curve(QUICK, sets, training, numbers, 1)
