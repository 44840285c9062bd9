"""Optimal trajectories with constraints, by multiple and by single shooting with one interior-point method.

    min  sum_k l(x_k, u_k) + l_N(x_N),   x_{k+1} = f(x_k, u_k),   c <= 0,   h(x_N) = 0

`shoot` takes the states at all knots as unknowns. The defect of a step, f(x_k, u_k) - x_{k+1}, vanishes only at the
solution: a guess need not be a motion, and an unstable system does not multiply its errors over the horizon (Bock and
Plitt 1984). `optimise` moves the controls alone: each trial is a motion under the gains of the step. Both use all
curvature, that of the steps included; through steps that are `integrated` by implicit methods, derivatives are those of
the implicit function theorem.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from dln_jax.control.conditions import Conditions, conditions
from dln_jax.control.interior_point import Iterate, Search, search, straight
from dln_jax.control.riccati import HorizonSolution
from dln_jax.control.trajectories import FIRST_DAMPING, Plan, TrajectoryProblem, first_plan
from dln_jax.solvers.ending import Ending
from dln_jax.types import InputError, require_positive

LARGEST_GRADIENT = 100.0
"""The cost is scaled such that its derivatives at the guess are not larger."""


class Shooting(NamedTuple):
    """Result of multiple shooting."""

    plan: Plan
    """Plan for `mpc` and for feedback along it; its states are the knots, a motion to within the defect."""
    multipliers: Float[Array, "N n"]
    """Derivatives of the cost to go by the states at the ends of the steps."""
    end_multipliers: Float[Array, " q"]
    """Of the equations of the end."""
    pressures: Float[Array, " M"]
    """Multipliers of the inequalities, not negative, in the order of `control.conditions`."""
    defect: Float[Array, ""]
    """Largest |f(x_k, u_k) - x_{k+1}|, in the states' units."""
    violation: Float[Array, ""]
    """Largest excess of an inequality or equation of the end, soft ones included."""
    stationarity: Float[Array, ""]
    """Largest derivative of the Lagrangian, for the cost divided by `scale`."""
    feasibility: Float[Array, ""]
    """Largest residual of all constraints with their slacks."""
    complementarity: Float[Array, ""]
    """Largest product of a slack and its multiplier."""
    scale: Float[Array, ""]
    """Number by which the cost was divided."""
    iterations: Int[Array, ""]
    ending: Int[Array, ""]
    """An `Ending`."""

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether all conditions of an optimum hold within the tolerance; `solvers.ending.reason` says why not."""
        return self.ending == Ending.CONVERGED


def shoot(
    problem: TrajectoryProblem,
    x: Any,
    states: Any,
    u: Any,
    *,
    iterations: int = 300,
    tolerance: float = 1e-8,
    exact: bool = True,
) -> Shooting:
    """Returns a locally optimal trajectory near a guess, by multiple shooting; traceable.

    Args:
        problem: to solve.
        x: initial state [n].
        states: guess [N+1, n], whose first is replaced by the initial state; it need not be a motion.
        u: guess [N, m].
        iterations: largest number of iterations.
        tolerance: of stationarity, feasibility and complementarity, with the cost scaled so that its derivatives at the
            guess are at most 100. Stationarity and complementarity are divided by a hundredth of the mean multiplier
            if that is above one.
        exact: whether to use the curvature of the steps and constraints; otherwise the method is Gauss-Newton.

    Raises:
        InputError: shapes that do not agree, settings that are not positive, or crossed limits.
    """
    x, states, u = (jnp.asarray(array, float) for array in (x, states, u))
    if x.ndim != 1 or u.ndim != 2 or not len(u) or states.shape != (len(u) + 1, x.shape[0]):
        raise InputError(
            f"x has shape {x.shape}, states {states.shape}, u {u.shape}; expected [n], [N+1, n] and [N, m]"
        )
    inside = _inside(states, problem.lower_x, problem.upper_x, "states")
    first = x if problem.free is None else jnp.where(jnp.asarray(problem.free), inside[0], x)
    u = _inside(u, problem.lower, problem.upper, "controls")
    return _solved(problem, inside.at[0].set(first), u, straight, iterations, tolerance, exact)


def optimise(
    problem: TrajectoryProblem, x: Any, u: Any, *, iterations: int = 300, tolerance: float = 1e-8, exact: bool = True
) -> Plan:
    """Returns a locally optimal plan from initial controls, by single shooting; traceable.

    The plan's `ending` states why it ended; all conditions of an optimum hold within the tolerance if it converged.

    Args:
        problem: to solve.
        x: initial state [n].
        u: initial controls [N, m].
        iterations: largest number of iterations.
        tolerance: as for `shoot`.
        exact: whether to use the curvature of the steps and constraints; otherwise the method is Gauss-Newton.
    """
    u = _inside(jnp.asarray(u, float), problem.lower, problem.upper, "controls")
    plan = first_plan(problem, x, u)

    def motion(at: Iterate, change: HorizonSolution, length: Array) -> tuple[Array, Array]:
        """The motion under the gains of the step."""

        def step(x: Array, stage: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
            about, u, dx, du, K = stage
            u = u + length * (du - K @ dx) + K @ (x - about)
            return problem.step(x, u), (x, u)

        first = at.x[0] + length * change.dx[0]
        last, (x, u) = jax.lax.scan(step, first, (at.x[:-1], at.u, change.dx[:-1], change.du, change.K))
        return jnp.concatenate([x, last[None]]), u

    plan = _solved(problem, plan.x, plan.u, motion, iterations, tolerance, exact).plan
    return plan._replace(u=jnp.clip(plan.u, problem.lower, problem.upper))


def _solved(
    problem: TrajectoryProblem, x: Array, u: Array, trial: Callable[..., Any], iterations: int, tolerance: float,
    exact: bool,
) -> Shooting:  # fmt: skip
    require_positive(iterations=iterations, tolerance=tolerance)
    shape, one = (*u.shape[:1], x.shape[1], u.shape[1]), jnp.ones((), x.dtype)

    def largest(slopes: Any) -> Array:
        return jnp.max(jnp.abs(jnp.append(slopes.cost.ravel(), slopes.end_cost)))

    unscaled = conditions(problem, shape, one, exact)
    scale = jnp.maximum(largest(unscaled.slopes(x, u)) / LARGEST_GRADIENT, 1.0)
    scale = jnp.where(jnp.isfinite(scale), scale, 1.0)
    of = conditions(problem, shape, 1 / scale, exact)
    soft = None if problem.soft is None else tuple(weight / scale for weight in problem.soft)
    last = search(of, trial, x, u, soft=soft, free=problem.free, iterations=iterations, tolerance=tolerance)
    return _result(problem, of, last, scale)


def _result(problem: TrajectoryProblem, of: Conditions, last: Search, scale: Array) -> Shooting:
    at, values, residuals = last.at, last.values, last.residuals
    excess = jnp.max(jnp.where(of.kinds.present, values.c, -jnp.inf), initial=0.0)
    plan = Plan(
        at.u, at.x, last.K, scale * values.cost, jnp.asarray(FIRST_DAMPING, at.u.dtype), jnp.asarray(True), last.ending
    )
    return Shooting(
        plan, scale * at.prices, scale * at.nu, scale * at.z, jnp.max(jnp.abs(values.defects)),
        jnp.maximum(excess, jnp.max(jnp.abs(values.h), initial=0.0)), *residuals, scale, last.iterations, last.ending,
    )  # fmt: skip


def _inside(guess: Array, lower: Any, upper: Any, name: str) -> Array:
    """Moves a guess inside its limits, by a hundredth of their distance."""
    if not any(isinstance(limit, jax.core.Tracer) for limit in (lower, upper)):
        low, high = np.broadcast_arrays(np.asarray(lower, float), np.asarray(upper, float))
        if crossed := np.flatnonzero(~(low < high)).tolist():
            raise InputError(f"limits {crossed} of the {name} are not in order; expected lower < upper")
    low, high = (jnp.asarray(limit, guess.dtype) for limit in (lower, upper))
    margin = jnp.minimum(1e-2 * (high - low), jnp.inf)
    one_low, one_high = (1e-2 * jnp.maximum(1.0, jnp.abs(limit)) for limit in (low, high))
    low = jnp.where(jnp.isfinite(low), low + jnp.minimum(one_low, margin), low)
    high = jnp.where(jnp.isfinite(high), high - jnp.minimum(one_high, margin), high)
    return jnp.clip(guess, low, high)
