"""Only as much model as the data needs: candidates of growing size, and the smallest that the validation calls enough.

A larger network always fits its training samples better, and soon fits their noise. Candidates are trained in order of
size. One is better than another when its validation error is lower by more than the standard error of their paired
difference over the validation samples (the one-standard-error rule of Breiman et al. 1984, paired).
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dln_jax.data.schema import Trajectories

STRETCH = 0.5
"""s of motion whose mean error counts as one measurement: neighbouring samples are not independent."""


class Trial(NamedTuple):
    """A candidate, and what came of it."""

    candidate: Any
    outcome: Any
    """What `fit` gave beside the errors, for example a `Training`."""
    errors: Float[np.ndarray, " N"]
    """Squared error of each validation sample."""

    @property
    def validation(self) -> float:
        """Mean squared error; inf where it is not finite."""
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
    """Trains candidates in the order given, smallest first; returns the chosen one and all that were trained.

    Chosen is the first whose error no other candidate betters significantly.

    Args:
        candidates: in order of size.
        fit: candidate -> outcome, and the squared error of each validation sample.
        patience: how many candidates in a row may bring no significant improvement before growing ends.
        target: mean squared error at which growing ends at once.
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
    """The first whose error no other betters significantly."""
    lowest = min(trials, key=lambda trial: trial.validation)
    return next(trial for trial in trials if not significantly_better(lowest.errors, trial.errors))


def stretches(data: Trajectories, seconds: float = STRETCH) -> Int[np.ndarray, " N"]:
    """The number of the stretch of time that each sample is in; stretches do not reach across trajectories."""
    within = np.floor(data.t / seconds).astype(int)
    within -= within.min()
    _, numbers = np.unique(data.trajectory * (within.max() + 1) + within, return_inverse=True)
    return numbers
