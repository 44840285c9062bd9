"""The published table of differential networks, trained by both optimisers."""

import itertools
import time
from collections.abc import Sequence
from functools import partial

from dln_jax.data import functions
from dln_jax.data.functions import FunctionSamples, SampleSplit
from dln_jax.learning.engine import optimisers
from dln_jax.learning.engine.optimisers import Adam, Optimiser
from dln_jax.learning.functions import (
    GAUSS_NEWTON,
    WIDTHS,
    Network,
    grow_width,
    published_adam,
    targets,
    train,
)
from dln_jax.metrics.functions import errors, predictions
from dln_jax.nn.activations import activation
from scripts.reports.case import Case, Findings, rows_of
from scripts.reports.published import DIFFERENTIAL_NETWORKS as TABLE
from scripts.reports.published import published
from scripts.reports.rows import Row, unit_of

OPTIMIZERS = ("gauss-newton", "adam")
LOSSES = ("type1", "type2")
ACTIVATIONS = ("relu", "softplus", "tanh", "cos")
QUANTITIES = ("value_mse", "gradient_mse", "hessian_mse")
FACTORS = {"sin": 30.0, "cos_sin": 10.0}
"""Our best error of a row must beat the best published one by this factor."""


def cases(
    *, samples: int = 25_600, seed: int = 0, steps: int = 40, coarse_steps: int = 200, epochs: int = 500
) -> list[Case]:
    """One case per function, loss, activation and optimiser; `InputError` for invalid settings.

    Gauss-Newton takes `steps` iterations on all samples at most, before those `coarse_steps` on some; Adam `epochs`.
    """
    problems = {
        "sin": (functions.sine(samples=samples, seed=seed), functions.sine_grid()),
        "cos_sin": (functions.cosine_sine(samples=samples, seed=seed), functions.cosine_sine_grid()),
    }
    listed = []
    for optimizer, function, loss, name in itertools.product(OPTIMIZERS, problems, LOSSES, ACTIVATIONS):
        if (optimizer, name) == ("gauss-newton", "relu"):
            continue
        data, test = problems[function]
        sets = functions.split(data, seed=seed)
        network = Network(loss=loss, activation=name, depth=1 if function == "sin" else 2, seed=seed)
        optimiser = published_adam(len(sets.train.x), epochs=epochs)
        if optimizer == "gauss-newton":
            network = network._replace(width=WIDTHS[0], precision="f64")
            optimiser = GAUSS_NEWTON._replace(steps=steps, coarse_steps=coarse_steps)
        targets(data, network)
        optimisers.check(optimiser)
        case = f"{function}/{loss}/{name}/{optimizer}"
        job = partial(findings, case, sets, test, network, optimiser)
        listed.append(Case(case, job, {case: (*QUANTITIES, "width", "job_seconds")}))
    return listed


def findings(case: str, sets: SampleSplit, test: FunctionSamples, network: Network, optimiser: Optimiser) -> Findings:
    """Trains one network and returns its numbers; Gauss-Newton grows the width from a small one."""
    return Findings(rows_of(case, trained(sets, test, network, optimiser)))


def trained(sets: SampleSplit, test: FunctionSamples, network: Network, optimiser: Optimiser) -> dict[str, float]:
    """Trains one network and measures it on the grid; validation chooses the width, except with Adam (published)."""
    began = time.perf_counter()
    if isinstance(optimiser, Adam):
        every = [training := train(sets, network, optimiser)]
    else:
        chosen, trials = grow_width(sets, network, lambda candidate: train(sets, candidate, optimiser))
        network, training, every = chosen.candidate, chosen.outcome, [trial.outcome for trial in trials]
    predicted = predictions(training.parameters, test.x, activation=activation(network.activation))
    return {
        **errors(predicted.mean, test),
        "width": network.width,
        **{name: sum(getattr(training, name) for training in every) for name in ("train_seconds", "compile_seconds")},
        "job_seconds": time.perf_counter() - began,
    }


def table_rows(rows: Sequence[Row]) -> list[Row]:
    """All numbers with their published references, the best of every published row, and the total time."""
    listed = []
    for row in rows:
        theirs = published(TABLE, row.case.rpartition("/")[0], row.quantity)  # without the optimiser
        listed.append(row._replace(unit=unit_of(row.quantity), reference=theirs))
    for function, factor in FACTORS.items():
        for quantity in QUANTITIES:
            ours = [row.value for row in rows if row.case.startswith(f"{function}/") and row.quantity == quantity]
            theirs = min(numbers[quantity] for case, numbers in TABLE.values.items() if case.startswith(f"{function}/"))
            listed.append(Row(f"{function}/best", quantity, min(ours), "1", theirs, theirs / factor))
    seconds = sum(row.value for row in rows if row.quantity == "job_seconds")
    return [*listed, Row("table/all", "table_seconds", seconds, "s", bound=900.0)]
