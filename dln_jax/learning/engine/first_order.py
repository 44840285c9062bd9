"""Training by a first-order optimiser, from parameters to the best of them, resumable at any dispatch."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import optax
from jax import Array

from dln_jax.learning.engine import fit
from dln_jax.learning.engine.runs import Checkpoint, Progress, Report, Training, plain, restore, silent, store


def train_first_order(
    loss: Callable[[Any, Any], Array],
    optimiser: optax.GradientTransformation,
    parameters: Any,
    arrays: Any,
    *,
    score: Callable[[Any], tuple[Array, Array]],
    seed: int | Array,
    steps: int,
    batch: int,
    patience: int,
    steps_per_dispatch: int = 200,
    seconds: float = math.inf,
    checkpoint: Checkpoint | None = None,
    report: Report = silent,
) -> Training:
    """Fits `loss(parameters, batch)` and keeps the parameters with the lowest score.

    Args:
        loss: mean loss of a batch.
        optimiser: an optax transformation, its schedule included.
        parameters: to start from; with a leading axis of seeds where `seed` is an array.
        arrays: pytree with samples on axis 0.
        score: parameters of ONE seed -> the value that is to be low, and one that is only shown.
        seed: of the shuffling; an array [K] trains K seeds in one program, each as it would alone.
        steps: as in `fit.make_fit`, like `batch` and `steps_per_dispatch`.
        batch: samples of a step.
        patience: steps without a better score after which training stops.
        steps_per_dispatch: steps between two scores.
        seconds: after which to stop, compilation included and since the call, also of a resumed run; looked at between
            dispatches, of which there is one at least. The learning rate falls as it would have without it.
        checkpoint: where to store the run after every dispatch, and whether to continue one.
        report: called after every dispatch.

    Raises:
        InputError: a checkpoint that does not fit.
    """
    prepared = fit.make_fit(
        loss, optimiser, arrays, steps=steps, batch=batch, score=score, steps_per_dispatch=steps_per_dispatch
    )
    if np.ndim(seed):
        prepared = fit.over_seeds(prepared)
    state = prepared.init(parameters, seed)
    state, history = restore(checkpoint, state) or (state, [])

    start = time.perf_counter()
    compiled = prepared.dispatch.lower(state, prepared.epochs_per_dispatch).compile()
    compile_seconds = time.perf_counter() - start

    earlier = history[-1].seconds if history else 0.0
    start = time.perf_counter()
    elsewhere = 0.0

    def on_dispatch(state: fit.FitState, record: fit.Record) -> None:
        nonlocal elsewhere
        history.append(Progress(*record, seconds=earlier + time.perf_counter() - start - elsewhere))
        began = time.perf_counter()
        if checkpoint is not None:
            store(checkpoint, state, history)
        report(history[-1])
        elsewhere += time.perf_counter() - began

    left = seconds - compile_seconds
    compiled_fit = prepared._replace(dispatch=compiled)
    state, stop = fit.run(compiled_fit, state, patience=patience, on_dispatch=on_dispatch, seconds=left)
    return Training(state.best_parameters, history, stop, plain(state.best_step), compile_seconds)
