"""Model selection by validation: fits candidates in turn, and keeps one by a rule.

A larger network always fits its training samples better, and soon fits their noise. A candidate is significantly better
than another if its validation error is lower by more than the standard error of their paired difference over the
validation samples (the one-standard-error rule of Breiman et al. 1984, paired). The rule `simplest` keeps the first
candidate that no other one significantly improves.
"""

import io
import itertools
import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from dln_jax.data.schema import Trajectories
from dln_jax.files import write_json
from dln_jax.learning.engine.checkpoint import Context
from dln_jax.types import InputError, SampleIndex, SampleVector

SEGMENT = 0.5
"""Length of a segment in s. Its mean error counts as one measurement, since neighbouring samples are correlated."""


class Trial(NamedTuple):
    """Candidate, outcome of its fit, and validation errors."""

    candidate: Any
    outcome: Any
    """The fit, or the reason for failure."""
    errors: Any
    """[N] squared error of each validation sample; `None` without a fit."""

    @property
    def validation(self) -> float:
        """Mean squared error; inf if it is missing or not finite."""
        mean = math.inf if self.errors is None else float(np.mean(self.errors))
        return mean if np.isfinite(mean) else math.inf


Selection = tuple[Trial, list[Trial]]
"""The chosen trial, and all trials."""


def significantly_better(errors: SampleVector, others: SampleVector, *, margin: float = 1.0) -> bool:
    """Whether `errors` are lower than `others` on average by more than `margin` standard errors of the difference."""
    gain = others - errors
    if not np.isfinite(gain.mean()):
        return bool(np.isfinite(np.mean(errors)))
    standard_error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else 0.0
    return bool(gain.mean() > margin * standard_error)


def lowest(trials: Sequence[Trial]) -> Trial:
    """Returns the trial with the lowest validation error."""
    return min(trials, key=lambda trial: trial.validation)


def simplest(trials: Sequence[Trial]) -> Trial:
    """Returns the first trial that no other one significantly improves."""
    best = lowest(trials)
    return next(trial for trial in trials if not significantly_better(best.errors, trial.errors))


def select(
    candidates: Iterable[Any],
    fit: Callable[[Any], tuple[Any, SampleVector | None]],
    *,
    rule: Callable[[Sequence[Trial]], Trial] = simplest,
    patience: int | float = math.inf,
    until: float = math.inf,
    stop: Callable[[Trial], bool] = lambda trial: False,
) -> Selection:
    """Fits candidates in order; returns the chosen trial and all trials.

    Args:
        candidates: candidates in order of size; an iterator may depend on earlier trials.
        fit: candidate -> outcome and squared error of each validation sample; or reason for failure, and `None`.
        rule: chooses among the trials with a fit.
        patience: stop after this many candidates in a row without significant improvement.
        until: reading of `time.perf_counter` at which the selection ends, after the first successful fit.
        stop: whether a trial is good enough to stop at once.

    Raises:
        InputError: no candidate could be fitted.
    """
    trials: list[Trial] = []
    best, waited = None, 0
    for candidate in candidates:
        trial = Trial(candidate, *fit(candidate))
        trials.append(trial)
        if trial.errors is not None:
            better = best is None or significantly_better(trial.errors, best)
            best, waited = (trial.errors, 0) if better else (best, waited + 1)
            if waited >= patience or stop(trial):
                break
        if best is not None and time.perf_counter() >= until:
            break
    fitted = [trial for trial in trials if trial.errors is not None]
    if not fitted or (any(trial.errors is None for trial in trials) and not np.isfinite(lowest(fitted).validation)):
        raise InputError(
            "no model could be fitted: " + "; ".join(f"{trial.candidate}: {trial.outcome}" for trial in trials)
        )
    return rule(fitted), trials


def segments(data: Trajectories, seconds: float = SEGMENT) -> SampleIndex:
    """Returns the index of each sample's time segment; segments do not cross trajectories."""
    within = np.floor(data.t / seconds).astype(int)
    within -= within.min()
    _, numbers = np.unique(data.trajectory * (within.max() + 1) + within, return_inverse=True)
    return numbers


def mean_of_segments(data: Trajectories, errors: Float[np.ndarray, "N ..."]) -> Float[np.ndarray, "S ..."]:
    """Averages the errors of samples over their time segments."""
    numbers = segments(data)
    sums = np.zeros((numbers.max() + 1, *errors.shape[1:]))
    np.add.at(sums, numbers, errors)
    return (sums.T / np.bincount(numbers)).T


def say_selection(context: Context, title: str, kept: str, ended: str, rows: Sequence[dict[str, Any]]) -> None:
    """Prints a table of the candidates and the reason for an early end; writes both into the run folder.

    Args:
        kept: name of the selected candidate.
        ended: reason for an early end; empty if all candidates were tried.
        rows: one dictionary per candidate, with its `name`; lists and texts are not shown.
    """
    shown = [key for key in dict.fromkeys(itertools.chain(*rows)) if key not in ("name", "joints", "reason")]
    table = Table("model", *(key.replace("_", " ").replace("mse", "MSE") for key in shown), "", title=title)
    for row in rows:
        values = (row.get(key) for key in shown)
        numbers = [
            f"{value:.3g}" if isinstance(value, float) else "" if value is None else f"{value}" for value in values
        ]
        table.add_row(row["name"], *numbers, "kept" if row["name"] == kept else "")
    text = io.StringIO()
    Console(file=text, highlight=False, soft_wrap=True).print(table)
    context.say(text.getvalue().rstrip())
    if ended:
        context.say(f"Stopped: {ended}.")
    if context.folder is not None:
        write_json(context.folder / "selection.json", {"kept": kept, "ended": ended, "candidates": list(rows)})
