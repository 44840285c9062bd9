"""Optimal trajectories by multiple shooting: the states at all knots are unknowns, and steps may be implicit.

    min  sum_k l(x_k, u_k) + l_N(x_N),   x_{k+1} = f(x_k, u_k),   lower <= u_k <= upper

The defect of a step, d_k = f(x_k, u_k) - x_{k+1}, vanishes only at the solution. A guess need not be a motion, and an
unstable system does not multiply its errors over the horizon (Bock and Plitt 1984).

Sequential quadratic programming: all steps are expanded at once, and `constrained_lq` solves for the changes of states
and controls. They are shortened until cost + nu |defects|_1 falls enough, with nu above the multipliers (Nocedal and
Wright 2006, section 18.3). A full step may instead lower the augmented Lagrangian, because near a solution the first
merit function can refuse steps that lead there (Maratos). Negative curvature of the costs is dropped. Through steps
that are `integrated` by implicit methods, derivatives are those of the implicit function theorem.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from dln_jax.control.constrained_lq import Horizon, least_cost
from dln_jax.control.trajectories import FIRST_DAMPING, Plan, TrajectoryProblem, expand
from dln_jax.solvers.ending import Ending
from dln_jax.solvers.lapack import symmetric_eigen
from dln_jax.types import InputError, require_positive

SHORTEST = 2.0**-12
"""Shortest step length that is tried."""
ENOUGH = 1e-4
"""Required share of the decrease that the slope predicts (Armijo)."""
ABOVE = 2.0
"""Ratio of nu to the largest multiplier."""
CLOSE = 1e-2
"""Relative predicted decrease below which a full step counts as close, so that the steps' curvature is used."""


class Shooting(NamedTuple):
    """Result of multiple shooting."""

    plan: Plan
    """Plan for `mpc` and for feedback along it; its states are the knots, a motion to within the defect."""
    multipliers: Float[Array, "N n"]
    """Derivatives of the cost to go by the states at the ends of the steps."""
    defect: Float[Array, ""]
    """Largest |f(x_k, u_k) - x_{k+1}|, in the states' units."""
    promised: Float[Array, ""]
    """Predicted decrease of the cost by the last change, relative to the cost."""
    iterations: Int[Array, ""]
    ending: Int[Array, ""]
    """An `Ending`."""

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether defects and predicted decrease are within the tolerance; `solvers.ending.reason` says why not."""
        return self.ending == Ending.CONVERGED


class _Knots(NamedTuple):
    x: Array
    u: Array
    K: Array
    cost: Array
    missed: Array
    """[N, n], the defects."""
    multipliers: Array
    promised: Array
    close: Array
    """Whether the last change was a full step with a small predicted decrease."""
    better: Array
    iterations: Array
    done: Array


def shoot(
    problem: TrajectoryProblem,
    x: Any,
    states: Any,
    u: Any,
    *,
    iterations: int = 100,
    tolerance: float = 1e-9,
    exact: bool = False,
) -> Shooting:
    """Returns the optimal trajectory near a guess; traceable.

    Args:
        problem: to solve.
        x: initial state [n].
        states: guess [N+1, n], whose first is replaced by the initial state; it need not be a motion.
        u: guess [N, m]; clipped to the limits.
        iterations: largest number of iterations.
        tolerance: of the defects, relative to 1 + |x|, and of the cost.
        exact: whether to use all curvature close to the optimum, including that of the steps: quadratic convergence,
            for more derivatives. Otherwise the method is Gauss-Newton.

    Raises:
        InputError: shapes that do not agree, or settings that are not positive.
    """
    require_positive(iterations=iterations, tolerance=tolerance)
    x, states, u = (jnp.asarray(array, float) for array in (x, states, u))
    if x.ndim != 1 or u.ndim != 2 or not len(u) or states.shape != (len(u) + 1, x.shape[0]):
        raise InputError(
            f"x has shape {x.shape}, states {states.shape}, u {u.shape}; expected [n], [N+1, n] and [N, m]"
        )
    states, u = states.at[0].set(x), jnp.clip(u, problem.lower, problem.upper)
    cost, missed = _judge(problem, states, u)
    no = jnp.asarray(False)
    knots = _Knots(
        states, u, jnp.zeros((*u.shape, x.shape[0]), u.dtype), cost, missed, jnp.zeros_like(missed),
        jnp.zeros_like(cost), no, ~no, jnp.asarray(0), no,
    )  # fmt: skip

    def going(knots: _Knots) -> Array:
        return (knots.iterations < iterations) & ~knots.done & knots.better & jnp.isfinite(knots.cost)

    last = jax.lax.while_loop(going, lambda knots: _iterate(problem, knots, tolerance, exact), knots)
    outcomes = [Ending.CONVERGED, Ending.NOT_FINITE, Ending.NO_DESCENT]
    ending = jnp.select([last.done, ~jnp.isfinite(last.cost), ~last.better], outcomes, Ending.OUT_OF_ITERATIONS)
    plan = Plan(last.u, last.x, last.K, last.cost, jnp.asarray(FIRST_DAMPING, u.dtype), ~no, ending)
    defect = jnp.max(jnp.abs(last.missed))
    return Shooting(plan, last.multipliers, defect, last.promised, last.iterations, ending)


def _iterate(problem: TrajectoryProblem, knots: _Knots, tolerance: float, exact: bool) -> _Knots:
    """Evaluates the knots and improves them."""
    n = knots.x.shape[1]
    horizon = _expand(problem, knots, exact)
    change = least_cost(horizon)
    linear = jnp.sum(horizon.gradients[:, :n] * change.dx[:-1]) + jnp.sum(horizon.gradients[:, n:] * change.du)
    linear = linear + horizon.end_gradient @ change.dx[-1]
    largest = jnp.max(jnp.abs(knots.missed))
    done = (largest <= tolerance * (1 + jnp.max(jnp.abs(knots.x)))) & (
        jnp.abs(linear) <= tolerance * jnp.abs(knots.cost)
    )
    nu = ABOVE * jnp.max(jnp.abs(change.multipliers))
    rho = nu / (1 + jnp.max(jnp.abs(knots.x)))

    def merits(cost: Array, missed: Array) -> Array:
        of_lagrangian = cost + jnp.sum(change.multipliers * missed) + rho / 2 * jnp.sum(missed**2)
        return jnp.stack([cost + nu * jnp.sum(jnp.abs(missed)), of_lagrangian])

    now = merits(knots.cost, knots.missed)
    priced = jnp.sum(change.multipliers * knots.missed) + rho * jnp.sum(knots.missed**2)
    slopes = linear - jnp.stack([nu * jnp.sum(jnp.abs(knots.missed)), priced])

    def judged(length: Array) -> tuple[Array, Array, Array, Array]:
        cost, missed = _judge(problem, knots.x + length * change.dx, knots.u + length * change.du)
        fell = merits(cost, missed) <= now + ENOUGH * length * slopes
        # At the solution, the remaining gain is below the rounding of the cost.
        return length, cost, missed, done | fell[0] | (fell[1] & (length == 1))

    def too_long(trial: tuple[Array, Array, Array, Array]) -> Array:
        return ~trial[3] & (trial[0] > SHORTEST)

    twice = jnp.asarray(2.0, knots.u.dtype), knots.cost, knots.missed, jnp.asarray(False)
    length, cost, missed, better = jax.lax.while_loop(too_long, lambda trial: judged(trial[0] / 2), twice)
    new = knots._replace(x=knots.x + length * change.dx, u=knots.u + length * change.du, cost=cost, missed=missed)
    kept = jax.tree.map(lambda new, old: jnp.where(better, new, old), new, knots)
    close = better & (length == 1) & (jnp.abs(linear) <= CLOSE * jnp.abs(knots.cost))
    # A step that fails with all curvature is retried without.
    return kept._replace(
        K=change.K, multipliers=change.multipliers, promised=-linear / jnp.abs(knots.cost), close=close,
        better=better | knots.close, iterations=knots.iterations + 1, done=done,
    )  # fmt: skip


def _judge(problem: TrajectoryProblem, x: Array, u: Array) -> tuple[Array, Array]:
    """Returns the cost, and the defects [N, n]."""
    missed = jax.vmap(problem.step)(x[:-1], u) - x[1:]
    return jnp.sum(jax.vmap(problem.cost)(x[:-1], u)) + problem.final_cost(x[-1]), missed


def _expand(problem: TrajectoryProblem, knots: _Knots, exact: bool) -> Horizon:
    """Returns the quadratic program at the knots."""
    n = knots.x.shape[1]
    horizon = expand(problem, knots.x, knots.u, knots.missed)
    curvatures = _not_negative(horizon.curvatures, horizon.end_curvature)
    if exact:

        def of_lagrangian() -> tuple[Array, Array]:
            both = jnp.concatenate([knots.x[:-1], knots.u], axis=1)
            prices = _adjoint(horizon.slopes[:, :, :n], horizon.gradients[:, :n], horizon.end_gradient)
            bent = jax.vmap(jax.hessian(lambda xu, price: price @ problem.step(xu[:n], xu[n:])))(both, prices)
            return horizon.curvatures + bent, horizon.end_curvature

        curvatures = jax.lax.cond(knots.close, of_lagrangian, lambda: curvatures)
    return horizon._replace(curvatures=curvatures[0], end_curvature=curvatures[1])


def _adjoint(slopes: Array, gradients: Array, end: Array) -> Array:
    """Multipliers [N, n] from the derivatives of the steps and of the costs by the states."""

    def back(after: Array, stage: tuple[Array, Array]) -> tuple[Array, Array]:
        slope, gradient = stage
        return gradient + slope.T @ after, after

    return jax.lax.scan(back, end, (slopes, gradients), reverse=True)[1]


def _not_negative(curvatures: Array, end: Array) -> tuple[Array, Array]:
    """Sets negative eigenvalues of the Hessians to zero."""
    n = len(end)
    every = jnp.concatenate([curvatures, jnp.zeros_like(curvatures[:1]).at[0, :n, :n].set(end)])
    sizes, axes = jax.vmap(symmetric_eigen)(every)
    kept = jnp.einsum("kij,kj,klj->kil", axes, jnp.maximum(sizes, 0.0), axes)
    return kept[:-1], kept[-1, :n, :n]
