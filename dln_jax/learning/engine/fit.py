"""The one loop of all trainings: dispatches of compiled steps, with checkpoints for resuming bit for bit."""

import math
import time
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from dln_jax.learning.engine import newton, optimisers
from dln_jax.learning.engine.checkpoint import Checkpoint, restore, store
from dln_jax.learning.engine.optimisers import Adam, Optimiser
from dln_jax.learning.engine.problem import (
    NO_START,
    Problem,
    Progress,
    ProgressReport,
    Stop,
    Training,
    plain,
    sharing,
    silent,
)
from dln_jax.process import held_back
from dln_jax.scale import local, of_first_process, replicate
from dln_jax.types import InputError, require_positive


class _Run(NamedTuple):
    state: Any
    stage: Array
    """[] index of the stage."""


def fit(
    problem: Problem,
    optimiser: Optimiser,
    *,
    checkpoint: Checkpoint | None = None,
    report: ProgressReport = silent,
    seconds: float | int = math.inf,
    must_start: bool = True,
    mesh: Mesh | None = None,
) -> Training:
    """Minimises a problem's loss and keeps the parameters with the lowest score.

    Args:
        problem: residual or loss, initial parameters, samples and score.
        optimiser: `Adam` or `GaussNewton`; the latter needs parameters and data in float64.
        checkpoint: where to store the run after every dispatch, and whether to resume a stored run.
        report: called after every dispatch.
        seconds: time limit of this call, compilation included, also for a resumed run. It is checked between
            dispatches; at least one dispatch runs. The schedule of the learning rate does not depend on it.
        must_start: whether an initial loss that is not finite raises an error; otherwise it is a result.
        mesh: devices that share the training. Several seeds are split over them, and every device trains its own. With
            one seed the samples are split: those of a step's batch for Adam, all of them for Gauss-Newton; every device
            computes the whole score. Checkpoints do not depend on the devices; results do only by rounding.

    Raises:
        InputError: settings are out of range, the initial loss is not finite, the checkpoint belongs to another run, or
            the number of devices does not divide the samples of a batch.
    """
    began = time.perf_counter()
    require_positive(seconds=seconds)
    optimisers.check(optimiser)
    shared = sharing(problem, mesh)
    if isinstance(optimiser, Adam):
        stages = optimisers.stages(problem, optimiser, shared)
    else:
        stages = newton.stages(problem, optimiser, shared)
    run = _Run(stages[0].start(None), jnp.asarray(0))
    run, history = restore(checkpoint, run) or (run, [])
    run = run._replace(state=replicate(run.state, mesh))
    train_seconds = history[-1].seconds if history else 0.0
    compile_seconds, dispatched, stop = 0.0, False, Stop("finished", 0)
    for number in range(first := int(run.stage), len(stages)):
        stage, dispatch = stages[number], None
        if number > first:
            run = _Run(replicate(stage.start(local(run.state, mesh)), mesh), jnp.asarray(number))
        while not (stop := stage.ended(run.state)):
            if dispatched and seconds < math.inf and of_first_process(time.perf_counter() - began >= seconds, mesh):
                stop = Stop("time", int(np.max(run.state.step)))
                break
            if dispatch is None:
                since = time.perf_counter()
                dispatch = stage.compile(run.state)
                compile_seconds += time.perf_counter() - since
            since, before = time.perf_counter(), np.array(run.state.step)
            with held_back():
                state, values = dispatch(run.state)
                loss, validation, monitor = (plain(value) for value in np.moveaxis(np.asarray(values), -1, 0))
                train_seconds += time.perf_counter() - since
                run, dispatched = run._replace(state=state), True
                ended = stage.ended(state)
                if ended and ended.reason == "not finite" and np.array_equal(before, state.step):
                    continue  # nothing to report, and the stored state is as good
                at = Progress(plain(state.step), loss, validation, monitor, train_seconds, stage.name)
                history.append(at)
                if checkpoint is not None:
                    store(checkpoint, run, history)
            report(at)
        if stop.reason == "time":
            break
    if must_start and stop == Stop("not finite", 0):
        raise InputError(NO_START)
    best = local(run.state.best, mesh)
    return Training(best.parameters, history, stop, plain(best.step), compile_seconds)
