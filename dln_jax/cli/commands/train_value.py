"""Train a value function: the cost to go of a plant as a network, whose slope is the best control in closed form.

Trains by fitted value iteration, or on the residual of the Hamilton-Jacobi-Bellman equation, prints how long that took
and what the law costs in the published evaluation (100 starts), and writes a run folder: value.safetensors and
value.json (load them with dln_jax.training.values.load_value), metrics.json and config.json.
"""

import contextlib
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from jax.sharding import Mesh

from dln_jax.cli.arguments import Unstated, choice, numbers_of, require_positive_if_given
from dln_jax.cli.options import Folder, Scaled
from dln_jax.cli.progress import progress
from dln_jax.cli.scaled import mesh_of
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.control.optimal.fitted import Iteration
from dln_jax.control.optimal.plants import PLANTS, ValuePlant
from dln_jax.files import finite, write_json
from dln_jax.precision import with_float64
from dln_jax.training.results import print_numbers
from dln_jax.training.values import (
    ITERATIONS,
    METHODS,
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
from dln_jax.types import InputError, require_positive, require_seed


@dataclass(frozen=True)
class Arguments(Folder, Scaled):
    """Plant, method, and where the results go."""

    plant: Annotated[str | None, choice(PLANTS, unstated=True)] = None
    """The plant and its costs (default: pendulum)."""
    method: Annotated[str | None, choice(METHODS, unstated=True)] = None
    """fitted: value iteration along trajectories of the model; residual: the equation itself, by Gauss-Newton
    (default: fitted)."""
    goal: Unstated[str] = None
    """Posture to hold, rad or m, separated by commas (default: upright)."""
    width: Unstated[int] = None
    """Of the hidden layers (default: 96; residual: 24)."""
    depth: Unstated[int] = None
    """Hidden layers (default: 3; residual: 2)."""
    members: Unstated[int] = None
    """Networks, of which V is the mean (default: 1)."""
    iterations: Unstated[int] = None
    """Of value iteration, or of Gauss-Newton for each discount (default: 48 or 80 by the plant; residual: 15)."""
    seed: int = 0
    """Of parameters and states."""
    seeds: int = 1
    """Trainings, of which the one with the best validation is kept."""
    starts: int = 100
    """Of the evaluation, hanging and anywhere each."""
    stored: Unstated[Path] = None
    """Folder of a run whose value function is evaluated on the plant that it was trained for; nothing is trained, so
    that only --starts, --out and --devices apply (default: train one)."""


def main(given: Arguments) -> None:
    """Trains and evaluates a value function, or evaluates a stored one, and writes the run folder."""
    mesh = mesh_of(given)
    require_positive(seeds=given.seeds, starts=given.starts)
    require_seed(given.seed, given.seeds)
    require_positive_if_given(given, ("width", "depth", "members", "iterations"))
    if given.stored is not None:
        evaluate_stored(given, given.stored)
        return
    given = dataclasses.replace(given, plant=given.plant or "pendulum", method=given.method or "fitted")
    name, method = str(given.plant), str(given.method)
    goal = posture(given.goal)
    plant = plant_named(name, goal)
    fit = usual(name, method)
    width, depth = given.width or fit.widths[0], given.depth or len(fit.widths)
    family = Family((width,) * depth, given.members or 1, scale=fit.scale)
    with command_folder(given, "train_value", family=dataclasses.asdict(family)) as folder:
        print(f"{name}: {method}, {family.members} x {depth} layers of {width}")
        trained = train(given, plant, family, fit.numbers, mesh)
        best = min(trained, key=lambda each: each.validation)
        save_value(folder, name, goal, family, best.parameters)
        numbers = {"train_seconds": best.train_seconds, "validation": best.validation}
        if len(trained) > 1:
            numbers |= over_seeds(trained)
        finish(folder, ValueRun(name, plant, family_of(plant, family), with_float64(best.parameters)), given, numbers)


OF_TRAINING = ("plant", "method", "goal", "width", "depth", "members", "iterations", "seed", "seeds")


def evaluate_stored(given: Arguments, stored: Path) -> None:
    """Evaluates a stored value function on its own plant; `InputError` for options that only training uses."""
    unused = [name for name in OF_TRAINING if getattr(given, name) != getattr(Arguments(), name)]
    if unused:
        raise InputError(
            f"--{unused[0]} does not go with --stored: the stored value function has its own plant and network; "
            f"leave --{unused[0]} out, or leave --stored out to train"
        )
    run = load_value(stored)
    with command_folder(dataclasses.replace(given, plant=run.name), "train_value") as folder:
        finish(folder, dataclasses.replace(run, parameters=with_float64(run.parameters)), given, {})


def train(given: Arguments, plant: ValuePlant, family: Family, numbers: Iteration, mesh: Mesh | None) -> list[Trained]:
    """Trains once per seed and shows the progress."""
    seeds = range(given.seed, given.seed + given.seeds)
    with contextlib.ExitStack() as stack:
        show: list[Callable[[int, str], None]] = []

        def report(done: int, total: int, text: str) -> None:
            if not show:
                show.append(stack.enter_context(progress(total, "iterations")))
            show[0](done, text)

        if given.method == "residual":
            return by_equation(plant, family, given.iterations or ITERATIONS, seeds, report, mesh)
        numbers = numbers._replace(iterations=given.iterations or numbers.iterations)
        return by_iteration(plant, family, numbers, seeds, report, mesh)


def over_seeds(trained: list[Trained]) -> dict[str, float]:
    """Median and worst validation, and median training time, over several seeds."""
    validation = [each.validation for each in trained]
    return {
        "validation_median": float(np.median(validation)),
        "validation_worst": float(np.max(validation)),
        "train_seconds_median": float(np.median([each.train_seconds for each in trained])),
    }


def finish(folder: Path, run: ValueRun, given: Arguments, numbers: dict[str, float]) -> None:
    """Evaluates a value function, prints the numbers and writes them to metrics.json."""
    numbers = numbers | measured(run.plant, run.law, count=given.starts)
    write_json(folder / "metrics.json", {key: finite(value) for key, value in numbers.items()})
    rows = [[key.replace("_", " "), f"{value:.4g}", "s" if "seconds" in key else ""] for key, value in numbers.items()]
    print_numbers(rows, title=f"returns from {given.starts} starts hanging, and anywhere")
    print(f"run folder: {folder}")


def posture(text: str | None) -> tuple[float, ...] | None:
    """Parses the coordinates of --goal; `InputError` for text that is not numbers."""
    if text is None:
        return None
    return numbers_of("--goal", text)
