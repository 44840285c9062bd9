"""Trains value functions, as a kind of the pipeline, or evaluates a stored one."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jax.sharding import Mesh

from dln_jax.cli.arguments import numbers_of, require_positive_if_given
from dln_jax.cli.progress import progress
from dln_jax.control.optimal.fitted import Iteration
from dln_jax.control.optimal.plants import ValuePlant
from dln_jax.files import finite
from dln_jax.precision import with_float64
from dln_jax.training.pipeline import Fitted, Judged, Kind
from dln_jax.training.values import (
    ITERATIONS,
    Family,
    Trained,
    ValueRun,
    by_equation,
    by_iteration,
    family_of,
    load_value,
    measured,
    plant_named,
    save_value,
    usual,
)
from dln_jax.types import require_positive, require_seed


class Case(NamedTuple):
    """A plant and the family of networks for its value function, or a stored value function."""

    name: str
    plant: ValuePlant
    goal: tuple[float, ...] | None
    method: str
    family: Family | None
    """`None` for a stored value function."""
    numbers: Iteration
    stored: ValueRun | None = None


def prepare(options: Any) -> Case:
    """Reads and checks everything that the options name."""
    require_positive(starts=options.starts)
    if options.stored is not None:
        run = load_value(options.stored)
        return Case(run.name, run.plant, None, "stored", None, Iteration(), run)
    require_positive(seeds=options.seeds)
    require_seed(options.seed, options.seeds)
    require_positive_if_given(options, ("width", "depth", "members", "iterations"))
    goal = None if options.goal is None else numbers_of("--goal", options.goal)
    plant, fit = plant_named(options.plant, goal), usual(options.plant, options.method)
    width, depth = options.width or fit.widths[0], options.depth or len(fit.widths)
    family = Family((width,) * depth, options.members or 1, scale=fit.scale)
    return Case(options.plant, plant, goal, options.method, family, fit.numbers)


def announce(case: Case) -> Iterator[str]:
    """A line on the plant, the method and the networks."""
    if case.family is not None:
        widths = case.family.widths
        yield f"{case.name}: {case.method}, {case.family.members} x {len(widths)} layers of {widths[0]}"


def fit(case: Case, options: Any, folder: Path, mesh: Mesh | None) -> Fitted:
    """Trains once per seed and keeps the best by validation; a stored value function is taken as it is."""
    if case.family is None or case.stored is not None:
        return Fitted({}, None, (case.stored, {}))
    trained = trainings(case, case.family, options, mesh)
    best = min(trained, key=lambda training: training.validation)
    numbers = {"train_seconds": best.train_seconds, "validation": best.validation}
    if len(trained) > 1:
        numbers |= over_seeds(trained)
    network = family_of(case.plant, case.family)
    return Fitted({}, best.parameters, (ValueRun(case.name, case.plant, network, best.parameters), numbers))


def trainings(case: Case, family: Family, options: Any, mesh: Mesh | None) -> list[Trained]:
    """Trains once per seed and shows the progress."""
    seeds = range(options.seed, options.seed + options.seeds)
    with contextlib.ExitStack() as stack:
        show: list[Callable[[int, str], None]] = []

        def report(done: int, total: int, text: str) -> None:
            if not show:
                show.append(stack.enter_context(progress(total, "iterations")))
            show[0](done, text)

        if case.method == "residual":
            return by_equation(case.plant, family, options.iterations or ITERATIONS, seeds, report, mesh)
        numbers = case.numbers._replace(iterations=options.iterations or case.numbers.iterations)
        return by_iteration(case.plant, family, numbers, seeds, report, mesh)


def over_seeds(trained: Sequence[Trained]) -> dict[str, float]:
    """Median and worst validation, and median training time, over several seeds."""
    validation = [training.validation for training in trained]
    return {
        "validation_median": float(np.median(validation)),
        "validation_worst": float(np.max(validation)),
        "train_seconds_median": float(np.median([training.train_seconds for training in trained])),
    }


def judge(case: Case, fitted: Fitted, options: Any, folder: Path) -> Judged:
    """Returns of the law in the published evaluation."""
    run, numbers = fitted.outcome
    run = ValueRun(run.name, run.plant, run.network, with_float64(run.parameters))
    numbers = numbers | measured(run.plant, run.law, count=options.starts)
    return Judged(
        metrics={key: finite(value) for key, value in numbers.items()},
        rows=lambda _: [
            (key.replace("_", " "), f"{value:.4g}", "s" if "seconds" in key else "") for key, value in numbers.items()
        ],
        title=f"returns from {options.starts} starts hanging, and anywhere",
        chosen={"plant": case.name},
    )


def save(folder: Path, fitted: Fitted, case: Case) -> None:
    """Stores a trained value function."""
    if case.family is not None:
        save_value(folder, case.name, case.goal, case.family, fitted.parameters)


VALUES = Kind(prepare, announce, fit, judge, save)
