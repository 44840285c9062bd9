"""Model selection by validation: the first of several candidates that no other betters significantly.

A larger network always fits its training samples better, and soon fits their noise. One candidate is better than
another if its validation error is lower by more than the standard error of their paired difference over the validation
samples (the one-standard-error rule of Breiman et al. 1984, paired). `grow` trains candidates of growing size.

`select_model` fits models of one recording, most structured and cheapest first. They are compared on the validation
motions by squared torque errors in units of the joints' variances, so that a wrist counts as much as a shoulder, and
the differences are taken over time segments. Models whose mass matrices are positive definite come before others,
unless they explain much less: without such a matrix, accelerations are wrong. The selection ends early if the errors
equal the noise of the torques, or rounding, and when time is up.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dln_jax.data.schema import Trajectories
from dln_jax.learning.objectives import squared_torque_errors, torque_scale
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, require_positive

SEGMENT = 0.5
"""Length in s of a segment whose mean error counts as one measurement: neighbouring samples are not independent."""
EXACT = 1e-12
"""No further candidate is tried once the normalised error of every joint is below this."""
LEAST_NOISE, MOST_NOISE = 0.5, 1.2
"""Range of a joint's error, relative to the noise's share of the torque's variance, that counts as that noise. A lower
error shows that the estimate of the noise is wrong."""


USEFUL, PRICE = 0.25, 10.0
"""Largest mean normalised error of a model that a verdict does not refuse, as in `metrics.verdict`, and the largest
factor on the least mean error that a positive definite mass matrix may cost."""


class Trial(NamedTuple):
    """Candidate, outcome of its training, and validation errors."""

    candidate: Any
    outcome: Any
    """First result of `fit`, for example a `Training`."""
    errors: Float[np.ndarray, " N"]
    """Squared error of every validation sample."""

    @property
    def validation(self) -> float:
        """Mean squared error; inf if it is not finite."""
        mean = float(np.mean(self.errors))
        return mean if np.isfinite(mean) else float("inf")


def significantly_better(
    errors: Float[np.ndarray, " N"], others: Float[np.ndarray, " N"], *, margin: float = 1.0
) -> bool:
    """Whether `errors` are lower than `others` on average, by more than `margin` standard errors of the difference."""
    if not np.isfinite(np.mean(errors)) or not np.isfinite(np.mean(others)):
        return bool(np.isfinite(np.mean(errors)))
    gain = others - errors
    standard_error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else 0.0
    return bool(gain.mean() > margin * standard_error)


def grow(
    candidates: Iterable[Any],
    fit: Callable[[Any], tuple[Any, Float[np.ndarray, " N"]]],
    *,
    patience: int = 2,
    target: float | None = None,
) -> tuple[Trial, list[Trial]]:
    """Trains candidates in order, smallest first; returns the chosen trial and all trials.

    The choice is the first candidate whose error no other betters significantly.

    Args:
        candidates: in order of size.
        fit: candidate -> outcome, and the squared error of every validation sample.
        patience: stop after this many candidates in a row without significant improvement.
        target: mean squared error at which to stop at once.
    """
    trials: list[Trial] = []
    best, waited = None, 0
    for candidate in candidates:
        trial = Trial(candidate, *fit(candidate))
        trials.append(trial)
        if best is None or significantly_better(trial.errors, best.errors):
            best, waited = trial, 0
        else:
            waited += 1
        if waited >= patience or (target is not None and trial.validation <= target):
            break
    return smallest_enough(trials), trials


def smallest_enough(trials: Sequence[Trial]) -> Trial:
    """Returns the first trial whose error no other betters significantly."""
    lowest = min(trials, key=lambda trial: trial.validation)
    return next(trial for trial in trials if not significantly_better(lowest.errors, trial.errors))


def segments(data: Trajectories, seconds: float = SEGMENT) -> Int[np.ndarray, " N"]:
    """Returns the index of every sample's time segment; segments end at the ends of trajectories."""
    within = np.floor(data.t / seconds).astype(int)
    within -= within.min()
    _, numbers = np.unique(data.trajectory * (within.max() + 1) + within, return_inverse=True)
    return numbers


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
    definite: bool = True
    """Whether the mass matrix is positive definite; true for models without one."""


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
    definite: Callable[[FittedModel], bool] = lambda fitted: True,
    report: Callable[[Assessment], None] = lambda step: None,
) -> Selection:
    """Fits candidates in order and chooses the first that no other betters significantly, definite ones before others.

    Args:
        candidates: candidates, most structured first; of two equally good ones the first is chosen.
        train: samples to fit; the variances of their torques are the units of the errors.
        validation: other motions.
        noise: standard deviation of the joints' torque noise, N m or N, if known; the selection ends at such errors.
        seconds: time limit; at least the first candidate that can be fitted is.
        definite: whether a model's mass matrix is positive definite; true for models without one.
        report: called with the result of every candidate.

    Raises:
        InputError: seconds that are not positive, torques that do not vary, or no candidate that could be fitted.
    """
    require_positive(seconds=seconds)
    began, steps, ended = time.perf_counter(), [], ""
    scale = np.asarray(torque_scale(train))
    for candidate in candidates:
        left = seconds - (time.perf_counter() - began)
        if ended or (left <= 0 and any(step.fitted for step in steps)):
            ended = ended or "time is out"
            step = Assessment(candidate.name, None, None, None, 0.0, ended, tried=False)
        else:
            step = _tried(candidate, max(left, 1e-3), scale, train, validation, definite)
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
    affordable = min(USEFUL, PRICE * min(trial.validation for trial in trials))
    sound = [trial for trial in trials if trial.candidate.definite and trial.validation <= affordable]
    best = smallest_enough(sound or trials)
    return Selection(best.candidate, best.outcome, tuple(steps), ended)


def _tried(
    candidate: Candidate,
    left: float,
    scale: Float[np.ndarray, " d"],
    train: Trajectories,
    validation: Trajectories,
    definite: Callable[[FittedModel], bool],
) -> Assessment:
    since = time.perf_counter()
    try:
        fitted = candidate.fit(left)
    except InputError as error:
        fitted = str(error)
    spent = time.perf_counter() - since
    if isinstance(fitted, str):
        return Assessment(candidate.name, None, None, None, spent, fitted)
    squares = squared_torque_errors(fitted.model, fitted.parameters, validation, scale)
    segment = segments(validation)
    counts = np.bincount(segment)
    errors = np.stack([np.bincount(segment, column) / counts for column in squares.T], axis=1)
    if not np.isfinite(errors).all():
        return Assessment(candidate.name, None, None, None, spent, "its torques are not finite on validation motions")
    return Assessment(candidate.name, fitted, errors, squares.mean(axis=0), spent, definite=definite(fitted))


def _ended(step: Assessment, share: Float[np.ndarray, " d"] | None) -> str:
    """Returns the reason why no other candidate can be better, or an empty string."""
    if step.nmse is None or not step.definite:
        return ""
    if (step.nmse <= EXACT).all():
        return f"{step.name} is exact"
    if share is not None and np.all((step.nmse >= LEAST_NOISE * share) & (step.nmse <= MOST_NOISE * share)):
        return f"the errors of {step.name} are the noise of the torques"
    return ""
