"""benchmark training: error against seconds for every model of the arm, by Gauss-Newton and by Adam."""

import time

from matplotlib.figure import Figure

from dln_jax.data.splits import Split
from dln_jax.figures.dynamics import error_against_time
from dln_jax.learning.dynamics_fit import train
from dln_jax.learning.linear_fit import fit_linear
from dln_jax.mechanics.equations import dynamics
from dln_jax.studies.arm.data import letters, published_split
from dln_jax.studies.arm.models import (
    SIZES,
    Curve,
    Measured,
    Size,
    curve,
    measure_adam,
    measure_seeds,
    measure_trigonometric,
    needs_of,
    prepared,
    torque_mse,
)
from dln_jax.studies.report import Row
from dln_jax.zoo.kinds import build, describe

ADAM_STEPS = 20_000
QUICK = "structured-delan"


def measure(quick: bool) -> tuple[list[Row], Figure]:
    """One seed of each on the embedded letters; the arm's table has medians of several."""
    sets = published_split(letters(None))
    if quick:
        jobs = {
            "trigonometric/letters": lambda: linear_alone(sets),
            f"{QUICK}/letters/gauss-newton": lambda: gauss_newton_alone(sets, steps=20),
        }
    else:
        jobs = {"trigonometric/letters": lambda: measure_trigonometric(sets)}
        for kind in SIZES:
            jobs[f"{kind}/letters/gauss-newton"] = lambda kind=kind: measure_seeds(kind, sets, seeds=1, steps=None)
            jobs[f"{kind}/letters/adam"] = lambda kind=kind: measure_adam(kind, sets, steps=ADAM_STEPS)
    rows, lines = [], {}
    for case, job in jobs.items():
        numbers, path = job()
        rows += [
            Row(case, "torque_mse", numbers["torque_mse"], "N^2 m^2"),
            Row(case, "train_seconds", numbers["train_seconds"], "s"),
        ]
        if path is not None:
            lines[case] = (path.seconds, path.errors)
    return rows, error_against_time(lines)


def linear_alone(sets: Split) -> Measured:
    """The linear fit, without the rollouts and latencies that the arm's table has beside it: they take far longer."""
    model = build(describe("trigonometric", sets.train, needs_of(sets), precision="f64", degree=1))
    began = time.perf_counter()
    parameters = fit_linear(model, sets.train).parameters
    seconds = time.perf_counter() - began
    numbers = {"torque_mse": torque_mse(dynamics(model.energies(parameters)), sets.test), "train_seconds": seconds}
    return numbers, Curve([seconds], [max(numbers["torque_mse"], 1e-32)])


def gauss_newton_alone(sets: Split, *, steps: int) -> Measured:
    """A few steps of a small network, likewise."""
    model, settings = prepared(QUICK, sets, Size(4, 1, "tanh", steps), steps)
    training = train(model, sets, settings)
    seconds = training.compile_seconds + training.train_seconds
    trained = dynamics(model.energies(training.parameters))
    numbers = {"torque_mse": torque_mse(trained, sets.test), "train_seconds": seconds}
    return numbers, curve(QUICK, sets, training, numbers, 1)
