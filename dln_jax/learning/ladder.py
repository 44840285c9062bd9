"""A ladder of models for one recording, those that state most and cost least first, and which of them it asks for.

Each rung is fitted to the training motions and judged by the validation motions: squared errors of each joint's torque
in units of its variance, so that a wrist counts as much as a shoulder. Chosen is the first rung whose mean error no
other betters by more than the standard error of their difference over stretches of time (`learning.growth`). The climb
ends early at errors that are the noise of the torques, or rounding, and when time is out.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.learning.growth import Trial, smallest_enough, stretches
from dln_jax.learning.objectives import TORQUE, arrays, residuals, torque_scale
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, require_positive

EXACT = 1e-12
"""Normalised error of every joint below which no rung is looked at any more."""
LEAST_NOISE, MOST_NOISE = 0.5, 1.2
"""Times the noise's share of a torque's variance, within which the error of a joint is that noise. Where an error is
lower, the estimated noise is none."""


class Fitted(NamedTuple):
    """What a rung came to."""

    model: Model
    parameters: Parameters
    outcome: Any = None
    """What else there is to keep."""


class Rung(NamedTuple):
    """A kind of model."""

    name: str
    fit: Callable[[float], Fitted | str]
    """Seconds that are left -> the fitted model, or why there is none. May raise InputError, which is such a reason."""


class Step(NamedTuple):
    """A rung, and how it did."""

    name: str
    fitted: Fitted | None
    errors: Float[np.ndarray, "S d"] | None
    """Normalised squared error of each stretch of validation motion, by joint; `None` where there is no model."""
    nmse: Float[np.ndarray, " d"] | None
    """Mean over validation samples, likewise."""
    seconds: float
    """Of the fit, compilation included."""
    reason: str = ""
    """Why there is no model."""
    tried: bool = True
    """Whether it was its turn."""


class Climb(NamedTuple):
    """The rungs that were tried or passed over, in order."""

    chosen: Step
    fitted: Fitted
    """The chosen model."""
    steps: tuple[Step, ...]
    ended: str
    """Why no further rung was tried; empty where all were."""


def climb(
    rungs: Sequence[Rung],
    train: Trajectories,
    validation: Trajectories,
    *,
    noise: Float[np.ndarray, " d"] | None = None,
    seconds: float = float("inf"),
    report: Callable[[Step], None] = lambda step: None,
) -> Climb:
    """Fits rungs in the order given, and chooses the first that no other is better than.

    Args:
        rungs: those that state most first; of two that do equally well the first is chosen.
        train: what they are fitted to, whose torques' variances are the units of errors.
        validation: other motions.
        noise: standard deviation of each measured torque, N m or N, where it is known: no rung is tried once that is
            all the error there is.
        seconds: after which no further rung is tried; the first that can be fitted is.
        report: told of every rung once it is done with.

    Raises:
        InputError: seconds that are not positive, torques that do not vary, or no rung that could be fitted.
    """
    require_positive(seconds=seconds)
    began, steps, ended = time.perf_counter(), [], ""
    scale = np.asarray(torque_scale(train))
    for rung in rungs:
        since = time.perf_counter()
        left = seconds - (since - began)
        if ended or (left <= 0 and any(step.fitted for step in steps)):
            ended = ended or "time is out"
            step = Step(rung.name, None, None, None, 0.0, ended, tried=False)
        else:
            step = _tried(rung, max(left, 1e-3), scale, train, validation)
            ended = _ended(step, None if noise is None else (noise / scale) ** 2)
        steps.append(step)
        report(step)
    trials = [
        Trial(step, step.fitted, step.errors.mean(axis=1))
        for step in steps
        if step.errors is not None and step.fitted is not None
    ]
    if not trials or not np.isfinite(min(trial.validation for trial in trials)):
        raise InputError("no model could be fitted: " + "; ".join(f"{step.name}: {step.reason}" for step in steps))
    best = smallest_enough(trials)
    return Climb(best.candidate, best.outcome, tuple(steps), ended)


def torque_errors(
    model: Model, parameters: Parameters, data: Trajectories, scale: Float[np.ndarray, " d"]
) -> Float[np.ndarray, "N d"]:
    """Squared error of each joint's torque at each sample, in float64, in units of the scale's square."""
    with jax.enable_x64(True):
        judge = jax.jit(lambda given, batch: residuals(TORQUE, model.energies(given), batch))
        errors = np.asarray(judge(parameters, arrays(TORQUE, data, jnp.float64)))
    return (errors / scale) ** 2


def _tried(
    rung: Rung, left: float, scale: Float[np.ndarray, " d"], train: Trajectories, validation: Trajectories
) -> Step:
    since = time.perf_counter()
    try:
        fitted = rung.fit(left)
    except InputError as error:
        fitted = str(error)
    spent = time.perf_counter() - since
    if isinstance(fitted, str):
        return Step(rung.name, None, None, None, spent, fitted)
    squares = torque_errors(fitted.model, fitted.parameters, validation, scale)
    stretch = stretches(validation)
    counts = np.bincount(stretch)
    errors = np.stack([np.bincount(stretch, column) / counts for column in squares.T], axis=1)
    if not np.isfinite(errors).all():
        return Step(rung.name, None, None, None, spent, "its torques are not finite on validation motions")
    return Step(rung.name, fitted, errors, squares.mean(axis=0), spent)


def _ended(step: Step, share: Float[np.ndarray, " d"] | None) -> str:
    """Why no other rung can be better, if so."""
    if step.nmse is None:
        return ""
    if (step.nmse <= EXACT).all():
        return f"{step.name} is exact"
    if share is not None and np.all((step.nmse >= LEAST_NOISE * share) & (step.nmse <= MOST_NOISE * share)):
        return f"the errors of {step.name} are the noise of the torques"
    return ""
