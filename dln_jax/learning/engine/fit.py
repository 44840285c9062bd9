"""The loop of all trainings: dispatches of compiled steps, with checkpoints that resume bit for bit.

Gauss-Newton (Levenberg-Marquardt) has one stage, or two if there are many samples: first a subset, then all.
"""

import functools
import math
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.sharding import Mesh

from dln_jax.errors import require_memory
from dln_jax.learning.engine import optimisers
from dln_jax.learning.engine.checkpoint import Checkpoint, restore, store
from dln_jax.learning.engine.optimisers import Adam, GaussNewton, Optimiser
from dln_jax.learning.engine.problem import (
    NO_START,
    Best,
    Dispatch,
    Problem,
    Progress,
    ProgressReport,
    Sharing,
    Stage,
    Stop,
    Training,
    better_of,
    by_devices,
    no_best,
    plain,
    sharing,
    silent,
)
from dln_jax.precision import compiled
from dln_jax.process import held_back
from dln_jax.scale import first, local, of_first_process, replicate, shard, spread
from dln_jax.solvers import levenberg_marquardt
from dln_jax.solvers.levenberg_marquardt import Arrays, LevenbergMarquardtState, Status
from dln_jax.types import InputError, require_positive

SOME, ALL = "some samples", "all samples"
"""Names of the two stages of a run that starts on a subset of the samples."""


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
    """Minimises the loss of a problem and keeps the parameters with the lowest score.

    Args:
        problem: residual or loss, initial parameters, samples and score.
        optimiser: `Adam`, or `GaussNewton` for parameters and data in float64.
        checkpoint: where to store the run after every dispatch, and whether to resume a stored run.
        report: called after every dispatch.
        seconds: time limit of this call with compilation, also for a resumed run. It is checked between dispatches, and
            at least one dispatch runs. The learning rate schedule does not depend on it.
        must_start: raise an error if the initial loss is not finite; otherwise report it in the result.
        mesh: devices that share the training. They split several seeds. With one seed they split the samples (of a
            batch for Adam, all for Gauss-Newton), and each computes the whole score. Checkpoints do not depend on the
            devices, and results only within rounding.

    Returns:
        The best parameters, the history of losses and scores, and the reason for the end (`stop`).

    Raises:
        InputError: settings are out of range, the initial loss is not finite, the checkpoint belongs to another run, or
            the number of devices does not divide the samples of a batch.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import dln_jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> x = jnp.linspace(0.0, 3.0, 50)
        >>> wave = dln_jax.Problem(
        ...     residual=lambda w, x, y: w[0] * jnp.sin(w[1] * x) - y,
        ...     parameters=jnp.ones(2),
        ...     arrays=(x, 0.5 * jnp.sin(1.2 * x)),
        ...     score=lambda w: (jnp.mean((w[0] * jnp.sin(w[1] * x) - 0.5 * jnp.sin(1.2 * x)) ** 2), jnp.nan),
        ... )
        >>> result = dln_jax.fit(wave, dln_jax.GaussNewton(steps=20))
        >>> print(result.parameters.round(6), result.stop.reason)
        [0.5 1.2] finished
    """
    began = time.perf_counter()
    require_positive(seconds=seconds)
    optimisers.check(optimiser)
    shared = sharing(problem, mesh)
    if isinstance(optimiser, Adam):
        stages = optimisers.stages(problem, optimiser, shared)
    else:
        stages = newton_stages(problem, optimiser, shared)
    run = _Run(stages[0].start(None), jnp.asarray(0))
    run, history = restore(checkpoint, run) or (run, [])
    run = run._replace(state=replicate(run.state, mesh))
    train_seconds = history[-1].seconds if history else 0.0
    compile_seconds, dispatched, stop = 0.0, False, Stop("finished", 0)
    for number in range(reached := int(run.stage), len(stages)):
        stage, dispatch = stages[number], None
        if number > reached:
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
                    continue  # the stored state is already the last good one
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


class NewtonState(NamedTuple):
    """State of a run; resuming from it is exact."""

    solver: LevenbergMarquardtState
    earlier: Array
    """[] iterations of the previous stage."""
    best: Best

    @property
    def step(self) -> int:
        """Number of iterations; the maximum over several seeds."""
        return int(self.earlier) + int(np.max(np.asarray(self.solver.iteration)))


def newton_stages(problem: Problem, optimiser: GaussNewton, shared: Sharing) -> list[Stage]:
    """Returns one stage, or two if the run starts on a subset of the samples."""
    if problem.residual is None:
        raise InputError("Gauss-Newton needs residuals, but this problem has only a loss; use Adam")
    leaves = jax.tree.leaves(problem.parameters)
    seeds = leaves[0].shape[0] if problem.several else 1
    count = sum(leaf.size for leaf in leaves) // seeds
    # The normal equations, their factor and a copy, in float64.
    require_memory(f"Gauss-Newton's equations for {count:,} parameters", 24.0 * seeds * count**2)
    arrays = jax.tree.map(jnp.asarray, problem.arrays)
    settings = {"improvement": optimiser.improvement, "mesh": shared.samples}
    iterate = functools.partial(levenberg_marquardt.run_on_chunks, problem.residual, **settings)
    stage = functools.partial(_newton_stage, problem, optimiser, shared, iterate)
    if not optimiser.has_coarse_stage(len(arrays[0])):
        return [stage("", arrays, optimiser.steps)]
    some = jax.tree.map(lambda array: array[: optimiser.coarse_samples], arrays)
    return [stage(SOME, some, optimiser.coarse_steps), stage(ALL, arrays, optimiser.steps)]


def _newton_stage(
    problem: Problem, optimiser: GaussNewton, shared: Sharing, iterate: Any, name: str, arrays: Arrays, iterations: int
) -> Stage:
    of_seeds = jax.vmap if problem.several else lambda function, *axes: function

    def start(before: NewtonState | None) -> NewtonState:
        if before is None:
            parameters = problem.parameters
            best, earlier = of_seeds(no_best)(jax.tree.map(jnp.array, parameters)), jnp.zeros((), int)
        else:
            parameters, best, earlier = before.best.parameters, before.best, jnp.asarray(before.step)
        return NewtonState(of_seeds(levenberg_marquardt.init)(parameters), earlier, best)

    def ended(state: NewtonState) -> Stop | None:
        if np.all(np.asarray(state.solver.status) == Status.NON_FINITE):
            return Stop("not finite", state.step)
        done = not remaining(state) or np.all(np.asarray(state.best.validation) <= optimiser.target)
        return Stop("finished", state.step) if done else None

    def remaining(state: NewtonState) -> int:
        """Largest number of remaining iterations over the seeds that still run."""
        solver = state.solver
        done = np.ravel(solver.iteration)[np.ravel(solver.status) == Status.RUNNING]
        return max(iterations - int(done.min()), 0) if done.size else 0

    def compile_(state: NewtonState) -> Dispatch:
        """Compiles two programs: the iterations (with quick compilation), and the score that keeps the best state."""
        chunks = jax.jit(lambda arrays: levenberg_marquardt.in_chunks(arrays, shared.samples))(arrays)
        chunks = replicate(chunks, shared.seeds) if shared.samples is None else shard(chunks, shared.samples)
        advance = spread(lambda whole, solver: iterate(solver, *whole, samples=len(arrays[0])), shared.seeds)
        advance = compiled(advance)
        advance = advance.lower((chunks, np.asarray(0)), state.solver).compile()

        def score(parameters: Any) -> Array:
            return first(jnp.stack(problem.score(parameters)), shared.samples)

        def judge(step: Array, seeds: tuple[Best, LevenbergMarquardtState]) -> tuple[Best, Array]:
            best, solver = seeds
            # One seed after the other: LAPACK calls in a score must not be batched (see `solvers.elimination`).
            scores = lax.map(score, solver.parameters) if problem.several else score(solver.parameters)
            better = of_seeds(better_of, (0, 0, 0, None))
            best = better(best, solver.parameters, scores[..., 0], jnp.asarray(step, jnp.int32))
            return best, jnp.concatenate([solver.loss[..., None], scores], axis=-1)

        judged = jax.jit(by_devices(judge, shared)).lower(state.step, (state.best, state.solver)).compile()

        def dispatch(state: NewtonState) -> tuple[NewtonState, Array]:
            steps = min(optimiser.steps_per_dispatch, remaining(state))
            state = state._replace(solver=advance((chunks, np.asarray(steps)), state.solver))
            best, values = judged(state.step, (state.best, state.solver))
            return state._replace(best=best), values

        return dispatch

    return Stage(name, start, compile_, ended)
