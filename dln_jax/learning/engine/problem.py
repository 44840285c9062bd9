"""What a training is given and what it gives, whatever is trained and by which optimiser."""

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.types import InputError, Scalar

NO_START = "the loss is not finite before training; look for very large numbers in the data"
"""What is refused where a training cannot begin."""


class Problem(NamedTuple):
    """What is made small, from where, and what is kept."""

    residual: Callable[..., Array] | None
    """(parameters, *sample) -> the residuals of one sample, of any shape; the loss is the mean over samples of the sum
    of their squares. `None` where the loss is no such sum."""
    parameters: Any
    """To start from."""
    arrays: tuple[Any, ...]
    """Samples on axis 0; `None` is handed on as it is."""
    score: Callable[[Any], tuple[Array, Array]]
    """Parameters of one seed -> the value that is to be low, and one that is only shown (NaN for none)."""
    seed: int | Array = 0
    """Of the order of the samples. An array [K] trains K seeds in one program, each as it would alone: the parameters
    then have a leading axis of K."""
    loss: Callable[[Any, Any], Array] | None = None
    """(parameters, batch) -> what Adam makes small, where that is not the mean of squared residuals."""
    loss_is_mean: bool = True
    """Whether `loss` is the mean of those of equal parts of a batch, so that devices may share its samples."""

    @property
    def several(self) -> bool:
        """Whether the parameters have a leading axis of seeds."""
        return np.ndim(self.seed) > 0


def loss_of(problem: Problem) -> Callable[[Any, Any], Scalar]:
    """(parameters of one seed, batch) -> the loss."""
    if problem.loss is not None:
        return problem.loss
    residual = problem.residual
    if residual is None:
        raise InputError("the problem has neither a residual nor a loss; give one of them")
    return lambda parameters, batch: mean_square(lambda *sample: residual(parameters, *sample), batch)


def mean_square(residual: Callable[..., Array], batch: tuple[Any, ...]) -> Scalar:
    """Mean over samples of the sum of squared residuals."""
    each = jax.vmap(residual)(*batch)
    return jnp.mean(jnp.sum(each**2, axis=tuple(range(1, each.ndim))))


def unmonitored(value: Scalar) -> tuple[Scalar, Scalar]:
    """A score beside which nothing is shown."""
    return value, jnp.full_like(value, jnp.nan)


def require_finite_start(problem: Problem, arrays: tuple[Any, ...]) -> None:
    """Raises `InputError` unless the (first seed's) loss on these arrays is finite where training starts.

    Takes a compilation.
    """
    parameters = jax.tree.map(lambda leaf: leaf[0], problem.parameters) if problem.several else problem.parameters
    options = {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else None
    if not np.isfinite(jax.jit(loss_of(problem), compiler_options=options)(parameters, arrays)):
        raise InputError(NO_START)


class Best(NamedTuple):
    """The parameters with the lowest score so far; with a leading axis where there are several seeds."""

    parameters: Any
    validation: Array
    """Their score; inf before the first."""
    step: Array
    """Step at which it was reached."""


def no_best(parameters: Any) -> Best:
    """Before the first score, of one seed."""
    dtype = jnp.result_type(*jax.tree.leaves(parameters))
    return Best(parameters, jnp.asarray(jnp.inf, dtype), jnp.zeros((), jnp.int32))


def better_of(best: Best, parameters: Any, validation: Array, step: Array) -> Best:
    """The better of one seed's best and its parameters of now; NaN is never better."""
    better = validation < best.validation
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), Best(parameters, validation, step), best)


class Progress(NamedTuple):
    """State of a run after a dispatch; numbers, or an array [seeds] where several train together."""

    step: Any
    loss: Any
    """Of Adam the mean over the steps of the dispatch."""
    validation: Any
    """The score that is to be low."""
    monitor: Any
    """The score that is only shown; NaN where nothing is monitored."""
    seconds: float
    """Training time so far, compilation and interruptions apart."""
    stage: str = ""
    """What is trained at the moment, where a training has several stages."""


class Stop(NamedTuple):
    """Why a run ended."""

    reason: str
    """"finished", "no improvement", "time" or "not finite"."""
    step: int
    """Steps taken; for "not finite" those after which the loss was not."""


class Training(NamedTuple):
    """What a run gives."""

    parameters: Any
    """Those with the lowest validation; with a leading axis where several seeds trained."""
    history: list[Progress]
    stop: Stop
    best_step: Any
    """Step of the lowest validation; an integer, or an array [seeds]."""
    compile_seconds: float

    @property
    def train_seconds(self) -> float:
        """Training time, compilation apart."""
        return self.history[-1].seconds if self.history else 0.0

    @property
    def validation(self) -> Any:
        """The lowest validation; inf before the first. A number, or an array [seeds]."""
        values = [at.validation for at in self.history]
        return plain(np.nanmin([np.full_like(values[0], np.inf, float), *values], axis=0)) if values else math.inf


Report = Callable[[Progress], None]


def silent(progress: Progress) -> None:
    """Reports nothing."""


def one_after_the_other(histories: Iterable[list[Progress]]) -> list[Progress]:
    """The histories of several trainings as one, whose steps and seconds go on."""
    joined: list[Progress] = []
    for history in histories:
        step, seconds = (joined[-1].step, joined[-1].seconds) if joined else (0, 0.0)
        joined += [at._replace(step=step + at.step, seconds=seconds + at.seconds) for at in history]
    return joined


def plain(values: Any) -> Any:
    """A scalar as a Python number, an array as a NumPy one."""
    array = np.asarray(values)
    return array if array.ndim else array.item()


Dispatch = Callable[[Any], tuple[Any, Array]]
"""state -> state, [loss, validation, monitor] or [seeds, 3]; the given state may be used up."""


class Stage(NamedTuple):
    """A stretch of a training that is one compiled program, as the loop in `fit` sees it.

    States are those of the optimiser: `step` and `best` are all that the loop reads of them.
    """

    name: str
    start: Callable[[Any], Any]
    """The state in which the stage before ended, `None` for the first -> the state before the first step."""
    compile: Callable[[Any], Dispatch]
    """A state -> some steps and their score, compiled."""
    ended: Callable[[Any], Stop | None]
    """A state -> why the stage is over, `None` while it is not."""
