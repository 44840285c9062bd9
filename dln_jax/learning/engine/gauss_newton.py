"""Gauss-Newton training: a host loop around the compiled Levenberg-Marquardt iterations.

    optimiser = make_levenberg_marquardt(sample_residual)
    result = minimise(optimiser, optimiser.init(parameters), (q, qd, qdd, tau), iterations=200)

Several seeds train in one program where the state has a leading axis: `jax.vmap(optimiser.init)(parameters, keys)`.
The loop itself keeps nothing: a run that starts from the state of a dispatch continues bit for bit.
"""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from dln_jax.solvers.levenberg_marquardt import LevenbergMarquardt, State, Status, make_levenberg_marquardt
from dln_jax.solvers.normal_equations import jacobian_bytes
from dln_jax.types import InputError

__all__ = [
    "LevenbergMarquardt",
    "Progress",
    "Result",
    "State",
    "Statistics",
    "Status",
    "jacobian_bytes",
    "make_levenberg_marquardt",
    "minimise",
]

_REASONS = {
    Status.GRADIENT: "the gradient is as small as asked",
    Status.STEP: "the step is as small as asked",
    Status.IMPROVEMENT: "an iteration improves as little as asked",
    Status.STALLED: "no damping lowers the loss any more: it is at its floor in this precision, or the derivatives are "
    "wrong",
    Status.NON_FINITE: "the loss is not finite; the parameters are the last with a finite loss. Check the data, "
    "or start with more damping",
    Status.ITERATIONS: "the iterations asked for are done",
    Status.TIME: "the time asked for is over",
    Status.TARGET: "the validation is as low as asked",
}


class Progress(NamedTuple):
    """What a dispatch came to; each a scalar, or [seeds]."""

    iteration: np.ndarray
    loss: np.ndarray
    validation: np.ndarray | None
    scores: np.ndarray | None
    """All that the validation function gave, [k] or [seeds, k]; `None` without one, or where it gives a scalar."""
    damping: np.ndarray
    gradient_norm: np.ndarray
    seconds: float
    """Since the call of `minimise`, compilation included."""


class Statistics(NamedTuple):
    """What a run took; counts are scalars or [seeds], over all runs that led to the state."""

    iterations: np.ndarray
    trials: np.ndarray
    fallbacks: np.ndarray
    seconds: float
    """Of this call, compilation included."""
    compile_seconds: float
    """Of these, until the optimiser was compiled."""


class Result(NamedTuple):
    """Parameters, what they are worth, why the run ended, and what it took."""

    parameters: Any
    """Those with the least validation, or the last ones where there is no validation."""
    value: np.ndarray
    """Their validation, or the loss; scalar or [seeds]."""
    status: np.ndarray
    """`Status` as an integer, scalar or [seeds]."""
    reason: str
    """The same in words; a line per seed."""
    statistics: Statistics
    state: State
    """The last state, to continue from."""


def minimise(
    optimiser: LevenbergMarquardt,
    state: State,
    arrays: tuple[Array | np.ndarray, ...],
    *,
    iterations: int,
    seconds: float = math.inf,
    target: float = -math.inf,
    dispatch: int = 10,
    validation: Callable[[Any], Array] | None = None,
    on_compiled: Callable[[float], object] | None = None,
    on_dispatch: Callable[[State, Progress], object] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Result:
    """Runs until `iterations` are done in total, time is over, or a stop rule holds.

    Args:
        optimiser: from `make_levenberg_marquardt`.
        state: from its `init`, or of an earlier dispatch.
        arrays: data, samples on axis 0.
        iterations: to be done in total, those that led to `state` included.
        seconds: after which to stop, in s; looked at between dispatches, of which there is one at least.
        target: validation at which to stop; of several seeds the worst counts.
        dispatch: iterations in one compiled call.
        validation: parameters of ONE seed -> scalar, jitted here and evaluated after each dispatch; the parameters with
            the lowest value are kept. Of a vector the first entry chooses, the rest is passed on.
        on_compiled: called with the seconds that compilation took, before the first dispatch.
        on_dispatch: shows progress and stores the state after each dispatch.
        clock: seconds, for `seconds` and the statistics.

    Raises:
        InputError: a dispatch of no iterations, or what the optimiser refuses in parameters and data.
    """
    if dispatch < 1:
        raise InputError(f"dispatch is {dispatch}; expected at least 1 iteration in a compiled call")
    start = clock()
    arrays = tuple(jnp.asarray(array) for array in arrays)
    several = state.iteration.ndim == 1
    evaluate = None
    if validation is not None:
        # One seed after the other: a validation that calls LAPACK must not do so for a batch (see the optimiser).
        evaluate = jax.jit((lambda stacked: lax.map(validation, stacked)) if several else validation)
    state = jax.block_until_ready(optimiser.run(state, arrays, 0))
    if evaluate is not None:
        jax.block_until_ready(evaluate(state.parameters))
    compile_seconds = clock() - start
    if on_compiled is not None:
        on_compiled(compile_seconds)

    reached = dispatched = False
    while remaining := _remaining(state, iterations):
        reached = bool(np.all(np.asarray(state.best_validation) <= target))
        late = clock() - start >= seconds
        if reached or (late and dispatched):
            break
        dispatched = True
        state = jax.block_until_ready(optimiser.run(state, arrays, min(dispatch, remaining)))
        values = scores = None
        if evaluate is not None:
            values = np.asarray(evaluate(state.parameters))
            if values.ndim > several:
                values, scores = values[..., 0], values
            state = _keep_best(state, values)
        if on_dispatch is not None:
            progress = Progress(
                iteration=np.asarray(state.iteration),
                loss=np.asarray(state.loss),
                validation=values,
                scores=scores,
                damping=np.asarray(state.damping),
                gradient_norm=np.asarray(state.gradient_norm),
                seconds=clock() - start,
            )
            on_dispatch(state, progress)

    ended_by = (Status.TARGET if reached else Status.TIME) if _remaining(state, iterations) else Status.ITERATIONS
    status = np.where(np.asarray(state.status) == Status.RUNNING, int(ended_by), np.asarray(state.status))
    validated = validation is not None
    return Result(
        parameters=state.best_parameters if validated else state.parameters,
        value=np.asarray(state.best_validation if validated else state.loss),
        status=status,
        reason="\n".join(
            f"iteration {iteration}: {_REASONS[Status(code)]}"
            for iteration, code in zip(np.ravel(state.iteration), np.ravel(status), strict=True)
        ),
        statistics=Statistics(
            iterations=np.asarray(state.iteration),
            trials=np.asarray(state.trials),
            fallbacks=np.asarray(state.fallbacks),
            seconds=clock() - start,
            compile_seconds=compile_seconds,
        ),
        state=state,
    )


def _remaining(state: State, iterations: int) -> int:
    """Iterations that the seeds which still run have to go."""
    done = np.ravel(state.iteration)[np.ravel(state.status) == Status.RUNNING]
    return max(iterations - int(done.min()), 0) if done.size else 0


@jax.jit
def _keep_best(state: State, values: Array) -> State:
    better = values < state.best_validation  # False for NaN

    def keep(best: Array, new: Array) -> Array:
        return jnp.where(jnp.reshape(better, better.shape + (1,) * (new.ndim - better.ndim)), new, best)

    return state._replace(
        best_parameters=jax.tree.map(keep, state.best_parameters, state.parameters),
        best_validation=keep(state.best_validation, values),
    )
