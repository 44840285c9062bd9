"""How each model is made and trained for a Hamiltonian task.

Spring and pendulum have noise on the states and none on the rates: models are fitted to rates first, and then to
trajectories with free starts, which takes away the bias of the noise. The other generated tasks have no noise: rates
alone. Measurements have no rates, only finite differences for a first fit: the result is that to trajectories.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import PER_SAMPLE
from dln_jax.deploy.phase_kinds import build_phase, describe_phase
from dln_jax.learning import trajectory_matching
from dln_jax.learning.field_matching import Settings, hold_out, match_field, match_linear
from dln_jax.learning.growth import grow
from dln_jax.learning.runs import Checkpoint, Report, Training, fingerprint, silent
from dln_jax.learning.second_order import Budget
from dln_jax.learning.trajectory_matching import Weights, cut_windows, match_trajectories
from dln_jax.types import InputError
from scripts.hnn_tasks import MEASURED, REAL, WINDOW, Problem

MODELS = ("hnn", "black-box-hnn", "baseline")
"""Of every task in the table; hnn is what suits the scene."""
POLYNOMIAL = "polynomial"
"""Of tasks with one coordinate and without friction, beside."""
KINDS = {
    "separable": "separable-hamiltonian",
    "structured": "structured-hamiltonian",
    "black-box": "black-box-hamiltonian",
    "black-box-hnn": "black-box-hamiltonian",
    "pairwise": "pairwise-hamiltonian",
    POLYNOMIAL: "polynomial-hamiltonian",
    "baseline": "phase-network",
}
DEGREES = range(2, 7)
VALIDATION_SHARE = 0.15
"""Of the trajectories for training."""


class Recipe(NamedTuple):
    """The networks of a task, and how long they train; chosen by trial on seed 0, and the same for all seeds."""

    suits: str
    """The model that suits the scene."""
    width: int
    """Hidden units per layer of that."""
    depth: int
    network: int
    """Hidden units per layer of the models that know less: a Hamiltonian that is one network, and the baseline."""
    network_depth: int
    steps: int
    """Iterations of Gauss-Newton on rates."""
    samples: int
    seconds: float
    """At most, of either fit, compilation included."""
    trajectory_steps: int = 0
    """Iterations of Gauss-Newton on trajectories, afterwards."""
    window: int = 0
    """Samples of a window."""
    weights: Weights | None = None
    """Of the trajectories; `None` for the deviations of the data."""
    substeps: int = 4


# The noise of spring and pendulum has sd 0.1; their rates have none, and are trusted to 0.01.
_NOISY = Weights(state=0.1, rate=0.01)
_SPRING = Recipe("separable", 8, 1, 16, 1, 40, 10_000, 60.0, 40, 30, _NOISY, 1)
_PENDULUM = _SPRING._replace(trajectory_steps=50, window=15)
RECIPES = {
    "spring": _SPRING,
    "pendulum": _PENDULUM,
    "damped-spring": _SPRING,
    "damped-pendulum": _PENDULUM,
    "henon-heiles": Recipe("separable", 12, 2, 24, 2, 100, 4_000, 60.0),
    "double-pendulum": Recipe("structured", 8, 2, 24, 2, 100, 4_000, 60.0),
    "two-body": Recipe("pairwise", 8, 1, 24, 2, 60, 3_000, 25.0),
    "three-body": Recipe("pairwise", 8, 1, 24, 2, 60, 4_000, 45.0),
    REAL: Recipe("separable", 4, 1, 8, 1, 40, 10_000, 30.0, 40, WINDOW[REAL], Weights(state=0.03), 1),
    MEASURED: Recipe("structured", 8, 1, 16, 1, 60, 10_000, 60.0, 60, WINDOW[MEASURED], None, 2),
}
ANCHOR = 30.0
"""How much less estimated momenta count than measured ones: their noise is amplified, but without any a model is free
to choose its own momentum."""
FRICTION_WIDTH = 4
"""Hidden units of the friction, where a scene has it; the model that is one network has one coefficient."""


class Trained(NamedTuple):
    """A model and how it came about."""

    description: dict[str, Any]
    """For `dln_jax.deploy.phase_kinds.build_phase`."""
    fits: list[Training]
    """One after the other; the last one's parameters are the result."""


def models_of(task: str) -> tuple[str, ...]:
    """The kinds of model that the table gives a task to."""
    return (*MODELS, POLYNOMIAL) if task in ("spring", "pendulum") else MODELS


def description_of(problem: Problem, model: str, *, precision: str = "f64", **keywords: Any) -> dict[str, Any]:
    """The description of a model for a task; `keywords` (width, depth, activation, degree) replace the recipe's."""
    recipe = RECIPES[problem.name]
    suits = model in ("hnn", "auto", recipe.suits)
    kind = KINDS.get(recipe.suits if suits else model)
    if kind is None:
        raise InputError(f"model '{model}' is unknown; choose from hnn, {', '.join(KINDS)}")
    if kind == KINDS[POLYNOMIAL]:
        degree = keywords.get("degree") or polynomial_degree(problem)
        return describe_phase(kind, problem.fitted, problem.needs, precision=precision, degree=degree)
    few = (recipe.width, recipe.depth) if suits else (recipe.network, recipe.network_depth)
    size = {"width": few[0], "depth": few[1], "activation": "tanh"}
    size |= {key: value for key, value in keywords.items() if value is not None and key in size}
    if problem.needs.friction and kind in (KINDS["separable"], KINDS["structured"]):
        size["friction_width"] = FRICTION_WIDTH
    return describe_phase(kind, problem.fitted, problem.needs, precision=precision, **size)


def polynomial_degree(problem: Problem) -> int:
    """The degree that the validation trajectories call enough."""
    fitted, validation = hold_out(problem.fitted, VALIDATION_SHARE, 0)

    def fit(degree: int):
        description = describe_phase(KINDS[POLYNOMIAL], fitted, problem.needs, degree=degree)
        return match_linear(build_phase(description), fitted, validation=validation)

    return grow(DEGREES, fit)[0].candidate


def train(
    problem: Problem,
    description: dict[str, Any],
    *,
    seed: int,
    optimizer: str = "gauss-newton",
    steps: int | None = None,
    learning_rate: float = 5e-3,
    directory: Path | None = None,
    resume: bool = False,
    report: Report = silent,
) -> Trained:
    """Fits a model to rates, and then to trajectories where the recipe says so."""
    recipe, model = RECIPES[problem.name], build_phase(description)
    settings = Settings(
        optimizer=optimizer,
        precision=description["precision"],
        steps=steps or recipe.steps,
        samples=recipe.samples,
        seconds=recipe.seconds,
        learning_rate=learning_rate,
        validation_share=VALIDATION_SHARE,
        seed=seed,
    )
    # As JSON reads it back, lists for tuples, so that a resumed run is recognised.
    stated = json.loads(json.dumps({**settings._asdict(), "model": description, "seconds": None}))
    numbers = fingerprint(getattr(problem.fitted, key) for key in PER_SAMPLE)

    def checkpoint(name: str) -> Checkpoint | None:
        identity = {"settings": stated, "data": numbers}
        return None if directory is None else Checkpoint(directory, identity, resume, f"checkpoint_{name}")

    parts = hold_out(problem.fitted, VALIDATION_SHARE, seed)
    if description["kind"] == KINDS[POLYNOMIAL]:
        fits = [match_linear(model, parts[0], validation=parts[1])[0]]
    else:
        fits = [match_field(model, problem.fitted, settings, checkpoint=checkpoint("rates"), report=report)]
    if recipe.trajectory_steps:
        windows = (cut_windows(part, recipe.window) for part in parts)
        first_order = trajectory_matching.Adam(learning_rate=learning_rate, seed=seed)
        fits.append(
            match_trajectories(
                model,
                fits[-1].parameters,
                *windows,
                weights=recipe.weights or deviations(parts[0]),
                budget=Budget(steps or recipe.trajectory_steps, seconds=recipe.seconds),
                adam=first_order if optimizer == "adam" else None,
                substeps=recipe.substeps,
                checkpoint=checkpoint("trajectories"),
                report=report,
            )
        )
    return Trained(description, fits)


def deviations(data: Trajectories) -> Weights:
    """Weights by the spread of the data; velocities that are finite differences of q only anchor the scale of p."""
    assert data.p is not None
    spread = [np.where(array.std(axis=0) > 0, array.std(axis=0), 1.0) for array in (data.q, data.p)]
    if "qd" in data.estimated and np.array_equal(data.p, data.qd):
        spread[1] = ANCHOR * spread[1]
    return Weights(state=tuple(float(size) for size in np.concatenate(spread)))
