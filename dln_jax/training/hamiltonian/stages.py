"""The two stages of a training, on rates and then on motions, in coordinates and momenta or in velocities."""

from typing import Any

import jax
import numpy as np

from dln_jax.data.arrays import spread
from dln_jax.data.schema import Trajectories, column
from dln_jax.learning import matching, shooting
from dln_jax.learning.engine import problem as engine
from dln_jax.learning.shooting import Gauge, Weights, Windows, cut_measured_windows, cut_windows
from dln_jax.training.hamiltonian.measurements import ANCHOR
from dln_jax.training.hamiltonian.recipes import RECIPES
from dln_jax.training.hamiltonian.tasks import Problem
from dln_jax.zoo.descriptions import build

LINEAR = {"trigonometric": ("degree",), "planar-chain": ("coordinates",)}
"""Models of measured motions whose parameters enter linearly, and their keywords."""
IN_VELOCITIES = ("structured-hnn", "structured-delan", *LINEAR)
"""Models of measured motions that are fitted in coordinates and velocities and define their own momenta."""
MOST_SUBSTEPS = 8
INTEGRATION_SHARE = 0.1
"""Largest integration error over a window, relative to the noise."""


def in_velocities(problem: Problem, description: dict[str, Any]) -> bool:
    """Whether a model is fitted in coordinates and velocities instead of momenta."""
    return problem.noise is not None and description["name"] in IN_VELOCITIES


def gauge_of(problem: Problem) -> Gauge:
    """The gauge: unit inertia with revolute joints at zero and prismatic joints at their mean."""
    means = zip(problem.needs.joints, problem.fitted.q.mean(axis=0), strict=True)
    return Gauge(tuple(0.0 if joint == "revolute" else float(mean) for joint, mean in means))


def first_problem(
    problem: Problem, description: dict[str, Any], parts: tuple[Trajectories, Trajectories], seed: int
) -> engine.Problem:
    """The fit of rates: accelerations, or (qd, pd)."""
    model, most = build(description), RECIPES[problem.name].samples
    if in_velocities(problem, description):
        initial = jax.jit(model.init)(jax.random.key(seed))
        return matching.accelerations_problem(
            model, initial, *parts, gauge=gauge_of(problem), most_samples=most, seed=seed
        )
    return matching.rates_problem(model, *parts, seed=seed, most_samples=most)


def second_problem(
    problem: Problem, description: dict[str, Any], parts: tuple[Trajectories, Trajectories], start: Any, seed: int
) -> engine.Problem:
    """The fit of motions, starting from parameters of the first fit."""
    recipe, model = RECIPES[problem.name], build(description)
    if problem.noise is not None and in_velocities(problem, description):
        known = {"noise": problem.noise, "gauge": gauge_of(problem), "substeps": recipe.substeps, "seed": seed}
        windows = [cut_measured_windows(part, recipe.window) for part in parts]
        return shooting.measured_problem(model, start, *windows, **known)
    windows = [cut_windows(part, recipe.window) for part in parts]
    weights = weights_of(problem, parts[0])
    substeps = recipe.substeps if problem.trust is None else substeps_of(windows[0], weights)
    return shooting.phase_problem(model, start, *windows, weights=weights, substeps=substeps, seed=seed)


def weights_of(problem: Problem, data: Trajectories) -> Weights:
    """Weights that divide the residuals of motions: the recipe's, or the noise of the measurements."""
    if problem.trust is not None:
        return problem.trust.weights
    return RECIPES[problem.name].weights or deviations(data)


def substeps_of(windows: Windows, weights: Weights) -> int:
    """RK4 steps between samples that keep the error over a window well below the noise, at most `MOST_SUBSTEPS`.

    For an oscillation of angular frequency w, a step h has an error of (w h)⁵ / 120 times the amplitude.
    """
    size = windows.state.reshape(-1, windows.state.shape[2]).std(axis=0)
    change = np.diff(windows.state, axis=1)[windows.weight[:, 1:] > 0]
    angle = np.max(np.sqrt(np.mean(change**2, axis=0)) / np.where(size > 0, size, np.inf))
    allowed = INTEGRATION_SHARE * np.min(np.asarray(weights.state) / np.where(size > 0, size, 1.0), initial=1.0)
    steps = np.arange(1, MOST_SUBSTEPS + 1)
    enough = windows.t.shape[1] * steps * (angle / steps) ** 5 / 120 <= allowed
    return int(steps[np.argmax(enough)]) if enough.any() else MOST_SUBSTEPS


def deviations(data: Trajectories) -> Weights:
    """Weights by the spread of the data; velocities from finite differences of q only anchor the scale of p."""
    p = column(data, "p")
    of_q, of_p = (np.where(size > 0, size, 1.0) for size in (spread("q", data.q), spread("p", p)))
    if "qd" in data.estimated and np.array_equal(p, data.qd):
        of_p = ANCHOR * of_p
    return Weights(state=tuple(np.concatenate([of_q, of_p]).tolist()))
