"""Inputs, stages and results of a training run for any model and optimiser, and the sharing of work by devices."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from dln_jax.data.arrays import on_device
from dln_jax.scale import on_devices, spread
from dln_jax.types import InputError, Scalar

NO_START = "the loss is not finite before training; look for very large numbers in the data"
"""Error message for an initial loss that is not finite."""


class Problem(NamedTuple):
    """A training problem for `fit`: residual or loss, initial parameters, samples and score.

    The loss is (1/N) Σₙ |r(w, sampleₙ)|². `fit` keeps the parameters with the lowest score, which usually is the error
    on validation samples. Functions and arrays are JAX's; units are your own.

    Example:
        >>> import jax.numpy as jnp
        >>> import dln_jax
        >>> x, held_out = jnp.linspace(-1.0, 1.0, 40), jnp.array([-0.5, 0.5])
        >>> square = dln_jax.Problem(
        ...     residual=lambda w, x, y: w["a"] * x**2 - y,
        ...     parameters={"a": jnp.zeros(())},
        ...     arrays=(x, 2 * x**2),
        ...     score=lambda w: (jnp.mean((w["a"] * held_out**2 - 2 * held_out**2) ** 2), jnp.nan),
        ... )
        >>> print(dln_jax.fit(square, dln_jax.Adam(steps=300, batch=8, learning_rate=0.1)).parameters["a"].round(2))
        2.0
    """

    residual: Callable[..., Array] | None
    """(parameters, *sample) -> residuals r of one sample, of any shape; `None` if you give `loss` instead."""
    parameters: Any
    """Initial parameters w, any tree of arrays."""
    arrays: tuple[Any, ...]
    """Samples on axis 0 of each array; a `None` is passed on."""
    score: Callable[[Any], tuple[Array, Array]]
    """Parameters of one seed -> the score to minimise, and a second score for display (NaN for none)."""
    seed: int | Array = 0
    """Seed of the sample order. An array [K] trains K seeds in one program, with the results of K separate runs; the
    parameters then have a leading axis of K."""
    loss: Callable[[Any, Any], Array] | None = None
    """(parameters, batch) -> loss for Adam, if it is not the mean of squared residuals."""
    loss_is_mean: bool = True
    """Whether `loss` averages over the samples, so that devices may split a batch."""

    @property
    def several(self) -> bool:
        """Whether the parameters have a leading axis of seeds."""
        return np.ndim(self.seed) > 0


def loss_of(problem: Problem) -> Callable[[Any, Any], Scalar]:
    """Returns (parameters of one seed, batch) -> loss."""
    if problem.loss is not None:
        return problem.loss
    residual = problem.residual
    if residual is None:
        raise InputError("the problem has neither a residual nor a loss; give one of them")
    return lambda parameters, batch: mean_square(lambda *sample: residual(parameters, *sample), batch)


def mean_square(residual: Callable[..., Array], batch: tuple[Any, ...]) -> Scalar:
    """Returns the mean over samples of the sum of squared residuals."""
    residuals = jax.vmap(residual)(*batch)
    return jnp.mean(jnp.sum(residuals**2, axis=tuple(range(1, residuals.ndim))))


def selected_by(
    held_out: tuple[Any, ...],
    residual: Callable[..., Array],
    parameters: Any,
    arrays: tuple[Any, ...],
    seed: int | Array = 0,
    *,
    error: Callable[..., Array] | None = None,
) -> Problem:
    """Builds a problem with the mean square of a residual over held-out samples as the score.

    Args:
        held_out: samples for the score.
        residual, parameters, arrays, seed: as in `Problem`.
        error: (parameters, *sample) -> residuals for the score, if they differ from the loss.
    """
    judged = error or residual

    def score(parameters: Any) -> tuple[Scalar, Scalar]:
        return unmonitored(mean_square(lambda *sample: judged(parameters, *sample), held_out))

    return Problem(residual, parameters, arrays, score, seed)


def arrays_of(record: Any, keys: Sequence[str], dtype: Any = jnp.float64) -> tuple[Array, ...]:
    """Copies fields of a record of NumPy arrays to the device; `InputError` if one is missing or squares overflow."""
    if missing := [key for key in keys if getattr(record, key) is None]:
        raise InputError(f"the data have no {', '.join(missing)}, but this fit needs it; add it to the file")
    return tuple(on_device(key, getattr(record, key), dtype) for key in keys)


def unmonitored(value: Scalar) -> tuple[Scalar, Scalar]:
    """Returns a score without a second score for display."""
    return value, jnp.full_like(value, jnp.nan)


class Best(NamedTuple):
    """Parameters with the lowest score so far. Several seeds add a leading axis."""

    parameters: Any
    validation: Array
    """Score of the parameters; inf before the first."""
    step: Array
    """Step that reached the score."""


def no_best(parameters: Any) -> Best:
    """State before the first score, for one seed."""
    dtype = jnp.result_type(*jax.tree.leaves(parameters))
    return Best(parameters, jnp.asarray(jnp.inf, dtype), jnp.zeros((), jnp.int32))


def better_of(best: Best, parameters: Any, validation: Array, step: Array) -> Best:
    """Returns the better of the best and the current parameters of one seed; NaN is never better."""
    better = validation < best.validation
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), Best(parameters, validation, step), best)


class Progress(NamedTuple):
    """Progress of a run after a dispatch: numbers, or arrays [seeds] if several seeds train together."""

    step: Any
    loss: Any
    """Training loss; for Adam, the mean over the steps of the dispatch."""
    validation: Any
    """Score that selects the parameters."""
    monitor: Any
    """Score for display only; NaN if nothing is monitored."""
    seconds: float
    """Training time so far, without compilation and interruptions."""
    stage: str = ""
    """Name of the current stage, if the training has several."""


class Stop(NamedTuple):
    """Why a run ended."""

    reason: str
    """"finished", "no improvement", "time" or "not finite"."""
    step: int
    """Number of steps; for "not finite", the steps before the first non-finite loss."""


class Training(NamedTuple):
    """Result of a run."""

    parameters: Any
    """Parameters with the lowest validation score. Several seeds add a leading axis."""
    history: list[Progress]
    stop: Stop
    best_step: Any
    """Step of the lowest validation score: an integer, or an array [seeds]."""
    compile_seconds: float

    @property
    def train_seconds(self) -> float:
        """Training time without compilation."""
        return self.history[-1].seconds if self.history else 0.0

    @property
    def validation(self) -> Any:
        """Lowest validation score, inf before the first: a number, or an array [seeds]."""
        return plain(np.fmin.reduce([at.validation for at in self.history], initial=math.inf))


ProgressReport = Callable[[Progress], None]


def silent(progress: Progress) -> None:
    """Reports nothing."""


def losses(at: Progress) -> str:
    """Formats the losses for a line of progress, as medians over seeds."""
    return f"loss {np.median(at.loss):.2e}  validation {np.median(at.validation):.2e}"


def one_after_the_other(histories: Iterable[list[Progress]]) -> list[Progress]:
    """Joins the histories of consecutive trainings; steps and seconds continue."""
    joined: list[Progress] = []
    for history in histories:
        step, seconds = (joined[-1].step, joined[-1].seconds) if joined else (0, 0.0)
        joined += [at._replace(step=step + at.step, seconds=seconds + at.seconds) for at in history]
    return joined


def plain(values: Any) -> Any:
    """Converts a scalar to a Python number, and an array to NumPy."""
    array = np.asarray(values)
    return array if array.ndim else array.item()


Dispatch = Callable[[Any], tuple[Any, Array]]
"""state -> state, [loss, validation, monitor] or [seeds, 3]; the argument may be donated."""


class Stage(NamedTuple):
    """Part of a training with one compiled program; the loop in `fit` reads only `step` and `best` of its states."""

    name: str
    start: Callable[[Any], Any]
    """Last state of the previous stage (`None` for the first) -> initial state."""
    compile: Callable[[Any], Dispatch]
    """State -> compiled dispatch of some steps and their score."""
    ended: Callable[[Any], Stop | None]
    """State -> reason for the end of the stage, or `None` to continue."""


class Sharing(NamedTuple):
    """Mesh that splits either the seeds or the samples."""

    seeds: Mesh | None
    """Each device trains its own seeds and sends only results; some devices may have one seed more."""
    samples: Mesh | None
    """Each device sums over its own samples, and each step adds these sums."""


def sharing(problem: Problem, mesh: Mesh | None) -> Sharing:
    """Decides whether the devices of a mesh split the seeds or the samples.

    Raises:
        InputError: a single seed, with a loss that is not a mean over samples.
    """
    if mesh is None or np.size(problem.seed) > 1:
        return Sharing(mesh, None)
    if problem.loss is not None and not problem.loss_is_mean:
        raise InputError("the loss is not a mean over samples, so devices cannot split a batch; train on one device")
    return Sharing(None, mesh)


def by_devices(function: Callable[[Any, Any], Any], shared: Sharing) -> Callable[[Any, Any], Any]:
    """Distributes a function of (whole, seeds) over devices, each with its own seeds.

    Devices that split the samples work on all seeds together, and the function itself adds their sums.
    """
    together = on_devices(lambda arguments, _: function(*arguments), shared.samples)
    return spread(lambda whole, seeds: together((whole, seeds), None), shared.seeds)
