"""benchmark training: error against seconds for every model of the arm, by Gauss-Newton and by Adam."""

from collections.abc import Callable
from functools import partial

from matplotlib.figure import Figure

from dln_jax.data.splits import Split
from dln_jax.figures.benchmarks import error_against_time
from dln_jax.learning.dynamics import problem
from dln_jax.learning.engine.fit import fit
from dln_jax.mechanics.equations import dynamics
from dln_jax.studies.arm.data import letters, published_split
from dln_jax.studies.arm.models import (
    SIZES,
    Curve,
    Measured,
    Size,
    curve,
    linear_fit,
    measure_adam,
    measure_seeds,
    measure_trigonometric,
    prepared,
    torque_mse,
)
from dln_jax.studies.case import Findings
from dln_jax.studies.report import Row

ADAM_STEPS = 20_000
QUICK = "structured-delan"


def measure(quick: bool) -> Findings:
    """One seed of each on the embedded letters; the arm's table has medians of several."""
    sets = published_split(letters(None))
    linear = linear_alone if quick else measure_trigonometric
    jobs: dict[str, Callable[[], Measured]] = {"trigonometric/letters": partial(linear, sets)}
    if quick:
        jobs[f"{QUICK}/letters/gauss-newton"] = partial(gauss_newton_alone, sets, steps=20)
    for kind in () if quick else SIZES:
        jobs[f"{kind}/letters/gauss-newton"] = partial(measure_seeds, kind, sets, seeds=1, steps=None)
        jobs[f"{kind}/letters/adam"] = partial(measure_adam, kind, sets, steps=ADAM_STEPS)
    rows, lines = [], {}
    for case, job in jobs.items():
        numbers, path = job()
        rows.append(Row(case, "torque_mse", numbers["torque_mse"], "N^2 m^2"))
        rows.append(Row(case, "train_seconds", numbers["train_seconds"], "s"))
        if path is not None:
            lines[case] = (path.seconds, path.errors)
    return Findings(rows, lines)


def draw(lines: dict) -> Figure:
    """Error against seconds of training."""
    return error_against_time(lines)


def linear_alone(sets: Split) -> Measured:
    """The linear fit, without the rollouts and latencies that the arm's table has beside it: they take far longer."""
    model, fitted, seconds = linear_fit(sets)
    numbers = {
        "torque_mse": torque_mse(dynamics(model.energies(fitted.parameters)), sets.test),
        "train_seconds": seconds,
    }
    return numbers, Curve([seconds], [max(numbers["torque_mse"], 1e-32)])


def gauss_newton_alone(sets: Split, *, steps: int) -> Measured:
    """A few steps of a small network, likewise."""
    model, optimiser = prepared(QUICK, sets, Size(4, 1, "tanh", steps), steps)
    training = fit(problem(model, sets), optimiser)
    seconds = training.compile_seconds + training.train_seconds
    trained = dynamics(model.energies(training.parameters))
    numbers = {"torque_mse": torque_mse(trained, sets.test), "train_seconds": seconds}
    return numbers, curve(QUICK, sets, training, numbers, 1)
