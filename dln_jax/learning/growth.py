"""Model selection by size: trains candidates of growing size, and takes the smallest that none betters significantly.

A larger network always fits its training samples better, and soon fits their noise. Candidates are trained in order of
size. One is better than another if its validation error is lower by more than the standard error of their paired
difference over the validation samples (the one-standard-error rule of Breiman et al. 1984, paired).
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dln_jax.data.schema import Trajectories

SEGMENT = 0.5
"""Length in s of a segment whose mean error counts as one measurement: neighbouring samples are not independent."""


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


def significantly_better(errors: Float[np.ndarray, " N"], others: Float[np.ndarray, " N"]) -> bool:
    """Whether `errors` are lower than `others` on average, by more than the standard error of the difference."""
    if not np.isfinite(np.mean(errors)) or not np.isfinite(np.mean(others)):
        return bool(np.isfinite(np.mean(errors)))
    gain = others - errors
    standard_error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else 0.0
    return bool(gain.mean() > standard_error)


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
