"""Training by Gauss-Newton (Levenberg-Marquardt), from parameters to the best of them, resumable at any dispatch.

With many more samples than parameters, the first iterations need not see them all: a run may start on a fixed part of
the samples, at a fraction of the cost, and end on all of them.
"""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.compilation import quick_compilation
from dln_jax.learning.engine import gauss_newton
from dln_jax.learning.engine.runs import Checkpoint, Progress, Report, Stop, Training, plain, restore, silent, store
from dln_jax.solvers.normal_equations import count, jacobian_bytes

MOST_PARAMETERS = 2_000
"""Above, an iteration's P³ is more than a thousand steps of Adam: `choose_optimizer` prefers those."""
MOST_BYTES = 2**31
"""Of the normal equations and a kept Jacobian, for `choose_optimizer`."""

STAGES = ("some samples", "all samples")
"""Of a run that starts on a part of the samples."""
COARSE_SAMPLES = 2_048
"""Samples of the first phase, unless the budget says otherwise."""

_REASONS = {
    gauss_newton.Status.NON_FINITE: "not finite",
    gauss_newton.Status.TIME: "time",
    gauss_newton.Status.ITERATIONS: "finished",
}


class Budget(NamedTuple):
    """How long Gauss-Newton runs."""

    steps: int
    """Iterations on all samples, at most."""
    coarse_steps: int = 0
    """Iterations before, at most, on `coarse_samples`."""
    coarse_samples: int = COARSE_SAMPLES
    """Samples of the first phase; the first ones, so they must be in random order. Sets of less than twice as many
    skip that phase."""
    improvement_tolerance: float = 0.0
    """Relative decrease of the loss in an iteration at which a phase ends."""
    seconds: float = math.inf
    """After which to stop, compilation included and since the call, also of a resumed run; looked at between
    dispatches, of which there is one at least, so that no run ends with the parameters that it started from."""
    target: float = -math.inf
    """Validation at which to stop."""


def train_second_order(
    sample_residual: Callable[..., Array],
    parameters: Any,
    arrays: tuple[Array, ...],
    *,
    score: Callable[[Any], tuple[Array, Array]],
    budget: Budget,
    seeds: bool = False,
    dispatch: int = 5,
    checkpoint: Checkpoint | None = None,
    report: Report = silent,
) -> Training:
    """Makes mean |sample_residual(parameters, *sample)|² small and keeps the parameters with the lowest score.

    Args:
        sample_residual: the residuals of one sample, float64.
        parameters: to start from; with a leading axis where there are several seeds.
        arrays: samples on axis 0.
        score: parameters of ONE seed -> the value that is to be low, and one that is only shown.
        budget: when to stop.
        seeds: whether the parameters have a leading axis of seeds, which then run in one program.
        dispatch: iterations between two scores.
        checkpoint: where to store the run after every dispatch, and whether to continue one.
        report: called after every dispatch.

    Raises:
        InputError: parameters or data are not float64, or a checkpoint that does not fit.
    """
    began = time.perf_counter()
    optimiser = gauss_newton.make_levenberg_marquardt(
        sample_residual,
        improvement_tolerance=budget.improvement_tolerance,
        compiler_options=quick_compilation(),
    )
    init = jax.vmap(lambda each: optimiser.init(each)) if seeds else optimiser.init
    coarse = budget.coarse_steps > 0 and len(arrays[0]) >= 2 * budget.coarse_samples
    # Optimiser, phase (0 on some samples, 1 on all), and the iterations of earlier phases.
    state = (init(parameters), jnp.asarray(0 if coarse else 1), jnp.asarray(0))
    state, history = restore(checkpoint, state) or (state, [])
    phase, before = int(state[1]), int(state[2])
    earlier = history[-1].seconds if history else 0.0
    compile_seconds = elsewhere = 0.0

    def on_compiled(seconds: float) -> None:
        nonlocal compile_seconds, elsewhere
        compile_seconds += seconds
        elsewhere += seconds

    def on_dispatch(optimised: gauss_newton.State, at: gauss_newton.Progress) -> None:
        nonlocal elsewhere
        seconds = earlier + time.perf_counter() - began - elsewhere
        value, shown = (plain(each) for each in np.moveaxis(np.asarray(at.scores), -1, 0))
        step, stage = before + int(np.max(at.iteration)), STAGES[phase] if coarse else ""
        history.append(Progress(step, plain(at.loss), value, shown, seconds, stage))
        storing_from = time.perf_counter()
        if checkpoint is not None:
            store(checkpoint, (optimised, jnp.asarray(phase), jnp.asarray(before)), history)
        report(history[-1])
        elsewhere += time.perf_counter() - storing_from

    def left() -> float:
        return budget.seconds - (time.perf_counter() - began)

    def run(optimised: gauss_newton.State) -> gauss_newton.Result:
        return gauss_newton.minimise(
            optimiser,
            optimised,
            arrays if phase else tuple(array[: budget.coarse_samples] for array in arrays),
            iterations=budget.steps if phase else budget.coarse_steps,
            seconds=left(),
            target=budget.target,
            dispatch=dispatch,
            validation=lambda each: jnp.stack(score(each)),
            on_compiled=on_compiled,
            on_dispatch=on_dispatch,
        )

    result = run(state[0])
    ended = (gauss_newton.Status.TIME, gauss_newton.Status.TARGET)
    if not phase and left() <= 0:
        result = result._replace(status=np.full_like(result.status, gauss_newton.Status.TIME))
    if not phase and not np.isin(result.status, ended).all():
        phase, before = 1, before + int(np.max(result.statistics.iterations))
        best = result.state.best_parameters, result.state.best_validation
        result = run(init(result.parameters)._replace(best_parameters=best[0], best_validation=best[1]))

    worst = gauss_newton.Status(int(np.max(result.status)))
    worst = gauss_newton.Status.NON_FINITE if np.all(result.status == gauss_newton.Status.NON_FINITE) else worst
    steps = before + int(np.max(result.statistics.iterations))
    return Training(
        result.parameters,
        history,
        Stop(_REASONS.get(worst, "finished"), steps),
        _best_steps(history),
        compile_seconds,
    )


def choose_optimizer(parameters: Any, samples: int, residuals: int) -> tuple[str, str]:
    """ "gauss-newton" or "adam", and why, in a sentence.

    Gauss-Newton takes P parameters to 1e-8 and below in seconds while its P x P equations are small; Adam's steps grow
    with P only.
    """
    size = count(parameters)
    needed = jacobian_bytes(parameters, samples, residuals, chunk_size=256, keep=False)
    if size <= MOST_PARAMETERS and needed <= MOST_BYTES:
        return "gauss-newton", f"{size:,} parameters: the normal equations take {needed / 2**20:,.0f} MiB"
    limit = f"{MOST_PARAMETERS:,} parameters" if size > MOST_PARAMETERS else f"{MOST_BYTES / 2**30:.0f} GiB"
    return "adam", f"{size:,} parameters need {needed / 2**20:,.0f} MiB of normal equations; the limit is {limit}"


def _best_steps(history: list[Progress]) -> Any:
    """Step of the lowest validation, of each seed."""
    if not history:
        return 0
    values = np.array([at.validation for at in history])
    best = np.argmin(np.where(np.isnan(values), np.inf, values), axis=0)
    return plain(np.array([at.step for at in history])[best])
