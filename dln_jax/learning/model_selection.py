"""Model selection for one recording: fits candidates, most structured and cheapest first, and chooses one.

Candidates are fitted to the training motions and compared on the validation motions by squared torque errors in units
of the joints' variances, so that a wrist counts as much as a shoulder. The choice is the first candidate whose mean
error no other betters by more than the standard error of their difference over time segments (`learning.growth`). The
selection ends early if the errors equal the noise of the torques, or rounding, and when time is up.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.learning.growth import Trial, segments, smallest_enough
from dln_jax.learning.objectives import TORQUE, arrays, residuals, torque_scale
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, require_positive

EXACT = 1e-12
"""No further candidate is tried once the normalised error of every joint is below this."""
LEAST_NOISE, MOST_NOISE = 0.5, 1.2
"""Range of a joint's error, relative to the noise's share of the torque's variance, that counts as that noise. A lower
error shows that the estimate of the noise is wrong."""


class FittedModel(NamedTuple):
    """A fitted candidate."""

    model: Model
    parameters: Parameters
    outcome: Any = None
    """Further results of the fit."""


class Candidate(NamedTuple):
    """A candidate of the model selection."""

    name: str
    fit: Callable[[float], FittedModel | str]
    """Remaining seconds -> the fitted model, or the reason why there is none. An InputError counts as a reason."""


class Assessment(NamedTuple):
    """A candidate and its validation errors."""

    name: str
    fitted: FittedModel | None
    errors: Float[np.ndarray, "S d"] | None
    """Normalised squared error of every segment of the validation motions, by joint; `None` without a model."""
    nmse: Float[np.ndarray, " d"] | None
    """Normalised mean squared error over the validation samples, by joint; `None` without a model."""
    seconds: float
    """Duration of the fit, compilation included."""
    reason: str = ""
    """Reason why there is no model."""
    tried: bool = True
    """Whether a fit was attempted."""


class Selection(NamedTuple):
    """Result of a model selection: all candidates in order, tried or not."""

    chosen: Assessment
    fitted: FittedModel
    """The chosen candidate's model."""
    steps: tuple[Assessment, ...]
    ended: str
    """Reason why no further candidate was tried; empty if all were."""


def select_model(
    candidates: Sequence[Candidate],
    train: Trajectories,
    validation: Trajectories,
    *,
    noise: Float[np.ndarray, " d"] | None = None,
    seconds: float = float("inf"),
    report: Callable[[Assessment], None] = lambda step: None,
) -> Selection:
    """Fits candidates in order and chooses the first that no other betters significantly.

    Args:
        candidates: candidates, most structured first; of two equally good ones the first is chosen.
        train: samples to fit; the variances of their torques are the units of the errors.
        validation: other motions.
        noise: standard deviation of the joints' measured torques, N m or N, if known: the selection ends once the
            errors equal it.
        seconds: time limit; at least the first candidate that can be fitted is.
        report: called with the result of every candidate.

    Raises:
        InputError: seconds that are not positive, torques that do not vary, or no candidate that could be fitted.
    """
    require_positive(seconds=seconds)
    began, steps, ended = time.perf_counter(), [], ""
    scale = np.asarray(torque_scale(train))
    for candidate in candidates:
        since = time.perf_counter()
        left = seconds - (since - began)
        if ended or (left <= 0 and any(step.fitted for step in steps)):
            ended = ended or "time is out"
            step = Assessment(candidate.name, None, None, None, 0.0, ended, tried=False)
        else:
            step = _tried(candidate, max(left, 1e-3), scale, train, validation)
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
    return Selection(best.candidate, best.outcome, tuple(steps), ended)


def torque_errors(
    model: Model, parameters: Parameters, data: Trajectories, scale: Float[np.ndarray, " d"]
) -> Float[np.ndarray, "N d"]:
    """Squared torque error of every sample and joint, computed in float64, in units of the squared scale."""
    with jax.enable_x64(True):
        judge = jax.jit(lambda given, batch: residuals(TORQUE, model.energies(given), batch))
        errors = np.asarray(judge(parameters, arrays(TORQUE, data, jnp.float64)))
    return (errors / scale) ** 2


def _tried(
    candidate: Candidate, left: float, scale: Float[np.ndarray, " d"], train: Trajectories, validation: Trajectories
) -> Assessment:
    since = time.perf_counter()
    try:
        fitted = candidate.fit(left)
    except InputError as error:
        fitted = str(error)
    spent = time.perf_counter() - since
    if isinstance(fitted, str):
        return Assessment(candidate.name, None, None, None, spent, fitted)
    squares = torque_errors(fitted.model, fitted.parameters, validation, scale)
    segment = segments(validation)
    counts = np.bincount(segment)
    errors = np.stack([np.bincount(segment, column) / counts for column in squares.T], axis=1)
    if not np.isfinite(errors).all():
        return Assessment(candidate.name, None, None, None, spent, "its torques are not finite on validation motions")
    return Assessment(candidate.name, fitted, errors, squares.mean(axis=0), spent)


def _ended(step: Assessment, share: Float[np.ndarray, " d"] | None) -> str:
    """Returns the reason why no other candidate can be better, or an empty string."""
    if step.nmse is None:
        return ""
    if (step.nmse <= EXACT).all():
        return f"{step.name} is exact"
    if share is not None and np.all((step.nmse >= LEAST_NOISE * share) & (step.nmse <= MOST_NOISE * share)):
        return f"the errors of {step.name} are the noise of the torques"
    return ""
