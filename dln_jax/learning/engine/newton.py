"""Gauss-Newton (Levenberg-Marquardt) as stages of `fit`: on a subset of the samples if there are many, then on all."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from dln_jax.errors import require_memory
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import (
    Best,
    Dispatch,
    Problem,
    Sharing,
    Stage,
    Stop,
    better_of,
    by_devices,
    no_best,
)
from dln_jax.precision import compiled
from dln_jax.scale import first, replicate, shard, spread
from dln_jax.solvers import levenberg_marquardt
from dln_jax.solvers.levenberg_marquardt import Arrays, LevenbergMarquardtState, Status
from dln_jax.types import InputError

SOME, ALL = "some samples", "all samples"
"""Names of the two stages of a run that starts on a subset of the samples."""


class NewtonState(NamedTuple):
    """State of a run; resuming from it is exact."""

    solver: LevenbergMarquardtState
    earlier: Array
    """[] iterations of the stage before this one."""
    best: Best

    @property
    def step(self) -> int:
        """Iterations done; with several seeds, their maximum."""
        return int(self.earlier) + int(np.max(np.asarray(self.solver.iteration)))


def stages(problem: Problem, optimiser: GaussNewton, shared: Sharing) -> list[Stage]:
    """Returns one stage, or two if the run starts on a subset of the samples."""
    if problem.residual is None:
        raise InputError("Gauss-Newton needs the residuals of a sample, which this problem lacks; take Adam")
    leaves = jax.tree.leaves(problem.parameters)
    seeds = leaves[0].shape[0] if problem.several else 1
    count = sum(leaf.size for leaf in leaves) // seeds
    # The normal equations, their factor and a copy, in float64.
    require_memory(f"Gauss-Newton's equations for {count:,} parameters", 24.0 * seeds * count**2)
    arrays = jax.tree.map(jnp.asarray, problem.arrays)
    settings = {"improvement": optimiser.improvement, "mesh": shared.samples}
    iterate = functools.partial(levenberg_marquardt.run_on_chunks, problem.residual, **settings)
    stage = functools.partial(_stage, problem, optimiser, shared, iterate)
    if not optimiser.has_coarse_stage(len(arrays[0])):
        return [stage("", arrays, optimiser.steps)]
    some = jax.tree.map(lambda array: array[: optimiser.coarse_samples], arrays)
    return [stage(SOME, some, optimiser.coarse_steps), stage(ALL, arrays, optimiser.steps)]


def _stage(
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
        """Largest number of iterations left to the seeds that still run."""
        solver = state.solver
        done = np.ravel(solver.iteration)[np.ravel(solver.status) == Status.RUNNING]
        return max(iterations - int(done.min()), 0) if done.size else 0

    def compile_(state: NewtonState) -> Dispatch:
        """Compiles two programs: the iterations (quickly), and their score with the best state so far."""
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
