"""How each model is made and trained for a Hamiltonian task.

Spring and pendulum have noise on the states and none on the rates: models are fitted to rates first, and then to
trajectories with free starts, which takes away the bias of the noise. The other generated tasks have no noise: rates
alone. Measurements have no rates, only finite differences for a first fit: the result is that to trajectories.
"""

import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from dln_jax.data.magnitudes import spread
from dln_jax.data.schema import Trajectories, column
from dln_jax.data.splits import PER_SAMPLE, hold_out
from dln_jax.learning import accelerations, measured_motions, motions, rates
from dln_jax.learning.engine import problem as engine
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton, Optimiser
from dln_jax.learning.engine.problem import Progress, Report, Training, silent
from dln_jax.learning.growth import grow
from dln_jax.learning.measured_motions import Gauge, cut_measured_windows
from dln_jax.learning.motions import Weights, cut_windows
from dln_jax.learning.rates import match_linear
from dln_jax.scale.mesh import of_first_process
from dln_jax.studies.hamiltonian.recipes import RECIPES
from dln_jax.studies.hamiltonian.tasks import Problem
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import CATALOGUE, entry_of
from dln_jax.zoo.descriptions import build, describe_for

MODELS = ("black-box-hnn", "phase-network")
"""Of every task in the table, beside the one that suits the scene."""
POLYNOMIAL = "polynomial-hamiltonian"
"""Of tasks with one coordinate and without friction, beside."""
DEGREES = range(2, 7)
LINEAR = {"trigonometric": ("degree",), "planar-chain": ("coordinates",)}
"""Models of measured motions whose parameters enter linearly, and their keywords."""
IN_VELOCITIES = ("structured-hnn", "structured-delan", *LINEAR)
"""Models of measured motions that are fitted in coordinates and velocities, whose momenta are their own."""
RATES, MOTIONS = "rates", "motions"
"""The stages of a training."""
WINDOWS_OF_A_STEP = 64
"""Of Adam, when it fits motions."""
VALIDATION_SHARE = 0.15
"""Of the trajectories for training."""


ANCHOR = 30.0
"""How much less estimated momenta count than measured ones: their noise is amplified, but without any a model is free
to choose its own momentum."""
FRICTION_WIDTH = 4
"""Hidden units of the friction, where a scene has it; the model that is one network has one coefficient."""


class Trained(NamedTuple):
    """A model and how it came about."""

    description: dict[str, Any]
    """For `dln_jax.zoo.build`."""
    fits: dict[str, Training]
    """By stage, one after the other; the last one's parameters are the result."""
    stopped: str = ""
    """Why a stage was left out, or ended before its time; empty where all went well."""
    diverged: bool = False
    """Whether that is a loss that stopped being finite."""

    @property
    def result(self) -> Training:
        """The last fit."""
        return list(self.fits.values())[-1]

    @property
    def history(self) -> list[Progress]:
        """Of all stages; their steps are counted on."""
        named = ([at._replace(stage=stage) for at in fit.history] for stage, fit in self.fits.items())
        return engine.one_after_the_other(named)


def models_of(task: str) -> tuple[str, ...]:
    """The models that the table gives a task to; the first is what suits the scene."""
    every = (RECIPES[task].suits, *MODELS)
    return (*every, POLYNOMIAL) if task in ("spring", "pendulum") else every


def description_of(problem: Problem, model: str, *, precision: str = "f64", **keywords: Any) -> dict[str, Any]:
    """The description of a model for a task, "auto" for what suits the scene.

    `keywords` (width, depth, activation, degree, coordinates) replace the recipe's.
    """
    recipe = RECIPES[problem.name]
    suits = model in ("auto", recipe.suits)
    name = recipe.suits if suits else model
    if problem.noise is not None and name in LINEAR:
        own = {key: value for key, value in keywords.items() if value is not None and key in LINEAR[name]}
        return describe_for(name, problem.fitted, problem.needs, precision=precision, **own)
    if not (entry_of(name).properties.canonical or (problem.noise is not None and name in IN_VELOCITIES)):
        known = ", ".join(name for name, entry in CATALOGUE.items() if entry.properties.canonical)
        raise InputError(f"model '{name}' is of no phase space; choose from auto, {known}")
    stated: dict[str, Any] = {"precision": precision, "pooled": True}
    if name == POLYNOMIAL:
        degree = keywords.get("degree") or polynomial_degree(problem)
        return describe_for(name, problem.fitted, problem.needs, **stated, degree=degree)
    few = (recipe.width, recipe.depth) if suits else (recipe.network, recipe.network_depth)
    size: dict[str, Any] = {"width": few[0], "depth": few[1], "activation": "tanh"}
    size |= {key: value for key, value in keywords.items() if value is not None and key in size}
    if problem.needs.friction and name in ("separable-hnn", "structured-hnn"):
        size["friction_width"] = FRICTION_WIDTH
    return describe_for(name, problem.fitted, problem.needs, **stated, **size)


def polynomial_degree(problem: Problem) -> int:
    """The degree that the validation trajectories call enough."""
    fitted, validation = hold_out(problem.fitted, VALIDATION_SHARE, 0)

    def fit(degree: int):
        description = describe_for(POLYNOMIAL, fitted, problem.needs, precision="f64", degree=degree)
        return match_linear(build(description), fitted, validation=validation)

    return grow(DEGREES, fit)[0].candidate


def stages_of(problem: Problem, description: dict[str, Any], steps: int | None = None) -> dict[str, int]:
    """The stages of a training that take steps, and how many each."""
    recipe = RECIPES[problem.name]
    most = {RATES: 0 if description["name"] == POLYNOMIAL else recipe.steps, MOTIONS: recipe.trajectory_steps}
    return {stage: steps or own for stage, own in most.items() if own}


def in_velocities(problem: Problem, description: dict[str, Any]) -> bool:
    """Whether a model is fitted in coordinates and velocities, rather than momenta."""
    return problem.noise is not None and description["name"] in IN_VELOCITIES


def gauge_of(problem: Problem) -> Gauge:
    """Unit inertia where revolute joints are at zero, and prismatic ones at their mean."""
    means = zip(problem.needs.joints, problem.fitted.q.mean(axis=0), strict=True)
    return Gauge(tuple(0.0 if joint == "revolute" else float(mean) for joint, mean in means))


def check(problem: Problem, description: dict[str, Any], *, seed: int) -> None:
    """Raises `InputError` for all that `train` would refuse in the data."""
    recipe = RECIPES[problem.name]
    parts = hold_out(problem.fitted, VALIDATION_SHARE, seed)
    fitted = first_problem(problem, description, parts, seed)
    if in_velocities(problem, description):
        engine.require_finite_start(fitted, fitted.arrays)
        second_problem(problem, description, parts, fitted.parameters, seed)
        return
    engine.require_finite_start(fitted, rates.samples(problem.fitted))
    if recipe.trajectory_steps:
        windows, validation = (cut_windows(part, recipe.window) for part in parts)
        motions.arrays(windows, validation, recipe.weights or deviations(parts[0]))


def train(
    problem: Problem,
    description: dict[str, Any],
    *,
    seed: int,
    optimiser: Optimiser = GaussNewton(),  # noqa: B008
    steps: int | None = None,
    seconds: float = math.inf,
    directory: Path | None = None,
    resume: bool = False,
    report: Report = silent,
    mesh: Mesh | None = None,
) -> Trained:
    """Fits a model to rates, and then to trajectories where the recipe says so, by as many steps as it or `steps` says.

    `seconds` are those of both, compilation included. Where they are over after the rates, or the fit of motions is not
    finite from its start, the fit of rates is the result. Devices of a mesh share the samples of both.
    """
    began = time.perf_counter()
    recipe, model = RECIPES[problem.name], build(description)
    numbers = [getattr(problem.fitted, key) for key in PER_SAMPLE]

    def fitted(stage: str, task: engine.Problem, most: int, file: str, seconds: float, **options: Any) -> Training:
        own = optimiser._replace(steps=steps or most)
        if isinstance(own, Adam):
            own = own._replace(patience=own.steps, batch=WINDOWS_OF_A_STEP if stage == MOTIONS else own.batch)
        known = identity(own, numbers, model=description, seed=seed, samples=recipe.samples)
        kept = None if directory is None else Checkpoint(directory, known, resume, f"checkpoint_{file}")
        staged = {"report": lambda at: report(at._replace(stage=stage)), "checkpoint": kept}
        return fit(task, own, **staged, seconds=seconds, mesh=mesh, **options)

    parts = hold_out(problem.fitted, VALIDATION_SHARE, seed)
    if description["name"] == POLYNOMIAL:
        first = match_linear(model, parts[0], validation=parts[1])[0]
    else:
        first = fitted(RATES, first_problem(problem, description, parts, seed), recipe.steps, "rates", seconds)
    fits = {RATES: first}
    left = of_first_process(seconds - (time.perf_counter() - began), mesh)
    if not recipe.trajectory_steps or first.stop.reason == "not finite":
        return _ended(description, fits, RATES, first)
    if first.stop.reason == "time" or left <= 0:
        return Trained(description, fits, "out of time after the fit of rates: motions were not fitted")
    task = second_problem(problem, description, parts, first.parameters, seed)
    second = fitted(MOTIONS, task, recipe.trajectory_steps, "trajectories", left, must_start=False)
    if not in_velocities(problem, description):
        second = second._replace(parameters=second.parameters["model"])
    if second.stop.step and np.isfinite(second.validation):
        fits[MOTIONS] = second
    return _ended(description, fits, MOTIONS, second)


def first_problem(
    problem: Problem, description: dict[str, Any], parts: tuple[Trajectories, Trajectories], seed: int
) -> engine.Problem:
    """The fit of rates: accelerations, or (qd, pd)."""
    model, most = build(description), RECIPES[problem.name].samples
    if in_velocities(problem, description):
        initial = jax.jit(model.init)(jax.random.key(seed))
        return accelerations.problem(model, initial, *parts, gauge=gauge_of(problem), most_samples=most, seed=seed)
    return rates.problem(model, *parts, seed=seed, most_samples=most)


def second_problem(
    problem: Problem, description: dict[str, Any], parts: tuple[Trajectories, Trajectories], start: Any, seed: int
) -> engine.Problem:
    """The fit of motions, from parameters of the first fit."""
    recipe, model = RECIPES[problem.name], build(description)
    if problem.noise is not None and in_velocities(problem, description):
        known = {"noise": problem.noise, "gauge": gauge_of(problem), "substeps": recipe.substeps, "seed": seed}
        windows = [cut_measured_windows(part, recipe.window) for part in parts]
        return measured_motions.problem(model, start, *windows, **known)
    weighted = {"weights": recipe.weights or deviations(parts[0]), "substeps": recipe.substeps, "seed": seed}
    return motions.problem(model, start, *(cut_windows(part, recipe.window) for part in parts), **weighted)


def _ended(description: dict[str, Any], fits: dict[str, Training], stage: str, last: Training) -> Trained:
    """With what is to be said of how the last fit ended."""
    at = f"after step {last.stop.step} of the fit of {stage}"
    words = {
        "time": f"out of time {at}: kept is the best so far",
        "not finite": f"the loss stopped being finite {at}; lower --learning-rate or look for very large numbers in "
        "the data",
    }
    return Trained(description, fits, words.get(last.stop.reason, ""), last.stop.reason == "not finite")


def deviations(data: Trajectories) -> Weights:
    """Weights by the spread of the data; velocities that are finite differences of q only anchor the scale of p."""
    p = column(data, "p")
    of_q, of_p = (np.where(size > 0, size, 1.0) for size in (spread("q", data.q), spread("p", p)))
    if "qd" in data.estimated and np.array_equal(p, data.qd):
        of_p = ANCHOR * of_p
    return Weights(state=tuple(np.concatenate([of_q, of_p]).tolist()))
