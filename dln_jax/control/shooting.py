"""Optimal trajectories with constraints, by multiple or single shooting and an interior-point method.

    min  sum_k l(x_k, u_k) + l_N(x_N),   x_{k+1} = f(x_k, u_k),   c <= 0,   h(x_N) = 0

`shoot` takes the states at all knots as unknowns. The defect of a step, f(x_k, u_k) - x_{k+1}, vanishes only at the
solution: a guess need not be a motion, and an unstable system does not multiply its errors over the horizon (Bock and
Plitt 1984). `optimise` moves the controls alone: each trial is a motion under the gains of the step. Both use the full
curvature, including that of the steps. Implicit steps made by `integrated` are differentiated by the implicit function
theorem.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import Bool, Float, Int

from dln_jax.control.barrier import Iterate
from dln_jax.control.conditions import Conditions, conditions
from dln_jax.control.contradictions import require_end, require_start
from dln_jax.control.interior_point import Search, straight
from dln_jax.control.phases import gave_up, phases
from dln_jax.control.riccati import HorizonSolution
from dln_jax.control.trajectories import FIRST_DAMPING, Plan, TrajectoryProblem, first_plan, followed, knots_of
from dln_jax.solvers.ending import Ending
from dln_jax.types import InputError, require_positive

HELD = 100.0
"""A constraint holds if its excess is at most this many tolerances: 1e-6 by default."""
LARGEST_GRADIENT = 100.0
"""The cost is scaled so that its derivatives at the guess do not exceed this."""


class Shooting(NamedTuple):
    """Result of multiple shooting."""

    plan: Plan
    """Plan for `mpc` and for feedback along it; its states are those at the knots, a motion to within the defect."""
    multipliers: Float[Array, "N n"]
    """Derivatives of the cost to go by the states at the ends of the steps."""
    end_multipliers: Float[Array, " q"]
    """Multipliers of the equations of the end."""
    pressures: Float[Array, " M"]
    """Multipliers of the inequalities, not negative, in the order of `control.conditions`."""
    defect: Float[Array, ""]
    """Largest |f(x_k, u_k) - x_{k+1}|, in the states' units."""
    violation: Float[Array, ""]
    """Largest excess of an inequality, soft ones included, or of an equation of the end."""
    objective: Float[Array, ""]
    """Cost plus the price of the excess of soft constraints; infinite if a hard constraint is violated."""
    stationarity: Float[Array, ""]
    """Largest derivative of the Lagrangian, for the cost divided by `scale`."""
    feasibility: Float[Array, ""]
    """Largest residual of all constraints with their slacks."""
    complementarity: Float[Array, ""]
    """Largest product of a slack and its multiplier."""
    scale: Float[Array, ""]
    """Divisor of the cost."""
    iterations: Int[Array, ""]
    ending: Int[Array, ""]
    """An `Ending`."""

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether all conditions of an optimum hold within the tolerance, and all constraints within 100 times it.

        `solvers.ending.reason` says why not.
        """
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
    starts: tuple[Any, Any] | None = None,
) -> Shooting:
    """Returns a locally optimal trajectory near a guess, by multiple shooting; traceable.

    The search leaves saddles. If it gives up where hard constraints are violated, another search restores them or shows
    that the problem is locally infeasible (see `control.phases`). The plan of `Ending.INFEASIBLE` has the least
    violation nearby; its residuals and multipliers are those of the sum of violations.

    Args:
        problem: problem to solve.
        x: initial state [n].
        states: guess [N+1, n], which need not be a motion; x replaces its first state, except for free components.
        u: guess [N, m].
        iterations: largest number of iterations of a search; leaving a saddle and restoring constraints are separate
            searches.
        tolerance: tolerance of stationarity, feasibility and complementarity, with the cost scaled so that its
            derivatives at the guess are at most 100. Stationarity and complementarity are divided by a hundredth of the
            mean multiplier if that is above one.
        exact: whether to use the curvature of the steps and constraints; otherwise the method is Gauss-Newton, which
            does not recognise saddles.
        starts: more guesses, states [G, N+1, n] and u [G, N, m]. All run as one program, and the best is kept: that of
            least objective within the hard constraints, or else of least violation.

    Raises:
        InputError: shapes do not agree, a setting is not positive, limits are crossed, the start violates the limits of
            the states or their constraints, or these limits exclude a linear constraint of the end.
    """
    if starts is not None:

        def one(states: Array, u: Array) -> Shooting:
            return shoot(problem, x, states, u, iterations=iterations, tolerance=tolerance, exact=exact)

        return _best(jax.vmap(one)(*_with_first((states, u), starts)))
    start = x
    x, states, u = (jnp.asarray(array, float) for array in (x, states, u))
    if x.ndim != 1 or u.ndim != 2 or not len(u) or states.shape != (len(u) + 1, x.shape[0]):
        raise InputError(
            f"x has shape {x.shape}, states {states.shape}, u {u.shape}; expected [n], [N+1, n] and [N, m]"
        )
    require_start(problem, start)
    inside = _inside(states, problem.lower_x, problem.upper_x, "states")
    first = x if problem.free is None else jnp.where(jnp.asarray(problem.free), inside[0], x)
    u = _inside(u, problem.lower, problem.upper, "controls")
    return _solved(problem, inside.at[0].set(first), u, straight, iterations, tolerance, exact)


def optimise(
    problem: TrajectoryProblem,
    x: Any,
    u: Any,
    *,
    iterations: int = 300,
    tolerance: float = 1e-8,
    exact: bool = True,
    starts: Any = None,
) -> Plan:
    """Returns a locally optimal plan from initial controls, by single shooting; traceable.

    The plan's `ending` states why the search ended; if it converged, all conditions of an optimum hold within the
    tolerance.

    Args:
        problem: problem to solve.
        x: initial state [n].
        u: initial controls [N, m].
        iterations: as for `shoot`.
        tolerance: as for `shoot`.
        exact: as for `shoot`.
        starts: more guesses [G, N, m], as for `shoot`.

    Raises:
        InputError: as for `shoot`.
    """
    plan = _single(problem, x, u, iterations, tolerance, exact) if starts is None else _best(
        jax.vmap(lambda u: _single(problem, x, u, iterations, tolerance, exact))(*_with_first((u,), (starts,)))
    )  # fmt: skip
    return plan.plan._replace(u=jnp.clip(plan.plan.u, problem.lower, problem.upper))


def _single(problem: TrajectoryProblem, x: Any, u: Any, iterations: int, tolerance: float, exact: bool) -> Shooting:
    u = _inside(jnp.asarray(u, float), problem.lower, problem.upper, "controls")
    plan = first_plan(problem, x, u)
    require_start(problem, x)

    def motion(at: Iterate, change: HorizonSolution, length: Array) -> tuple[Array, Array]:
        """Returns the motion under the gains of the step."""
        k = length * (change.du - jnp.einsum("kij,kj->ki", change.K, change.dx[:-1]))
        first = at.x[0] + length * change.dx[0]
        return followed(problem, first, (at.x[:-1], at.u, k, change.K), lambda u, _: u)

    return _solved(problem, plan.x, plan.u, motion, iterations, tolerance, exact)


def _solved(
    problem: TrajectoryProblem, x: Array, u: Array, trial: Callable[..., Any], iterations: int, tolerance: float,
    exact: bool,
) -> Shooting:  # fmt: skip
    require_positive(iterations=iterations, tolerance=tolerance)
    require_end(problem, x.shape[1])
    shape, (knots, last_knot) = (len(u), x.shape[1], u.shape[1]), knots_of(problem)

    def cost(x: Array, u: Array) -> Array:
        return jnp.sum(jax.vmap(problem.cost)(x[:-1], u, *knots)) + problem.final_cost(x[-1], *last_knot)

    gradients = jax.grad(cost, argnums=(0, 1))(x, u)
    scale = jnp.maximum(jnp.max(jnp.abs(jnp.concatenate([g.ravel() for g in gradients]))) / LARGEST_GRADIENT, 1.0)
    scale = jnp.where(jnp.isfinite(scale), scale, 1.0)

    def of(weight: Array, held: Array) -> Conditions:
        return conditions(problem, shape, weight / scale, exact, held)

    soft = None if problem.soft is None else (problem.soft[0] / scale, problem.soft[1] / scale)
    last, weight = phases(of, trial, x, u, soft=soft, free=problem.free, iterations=iterations, tolerance=tolerance)
    return _result(of(jnp.ones(()), jnp.ones(())), last, scale / weight, tolerance, problem.soft, weight == 1)


def _result(
    of: Conditions, last: Search, scale: Array, tolerance: float, soft: Any, not_restored: Array
) -> Shooting:  # fmt: skip
    at, values, residuals = last.at, last.values, last.residuals
    present = of.kinds.present
    rows, (above, below) = len(present), jnp.split(at.z[len(present) :], 2)
    excess = jnp.where(present, jnp.maximum(values.c[:rows], 0.0), 0.0)
    violation = jnp.maximum(jnp.max(excess, initial=0.0), jnp.max(values.c[rows:], initial=0.0))
    outside = gave_up(last.ending) & (residuals.feasibility > jnp.sqrt(tolerance))
    exceeded = (last.ending == Ending.CONVERGED) & (violation > HELD * tolerance)
    ending = jnp.select([outside, exceeded], [Ending.VIOLATED, Ending.EXCEEDED], last.ending)
    damping, cost = jnp.asarray(FIRST_DAMPING, at.u.dtype), scale * values.cost
    w_1, w_2 = soft or (0.0, 0.0)
    objective = cost + jnp.sum(jnp.where(of.kinds.soft, w_1 * excess + w_2 / 2 * excess**2, 0.0))
    # After a search that minimised violations, feasibility does not count them.
    held = not_restored & (residuals.feasibility <= HELD * tolerance)
    plan = Plan(at.u, at.x, last.change.K, cost, damping, jnp.asarray(True), ending)
    return Shooting(
        plan, scale * at.prices, scale * (at.nu + above - below), scale * at.z[:rows],
        jnp.max(jnp.abs(values.defects)), violation, jnp.where(held, objective, jnp.inf), *residuals,
        scale, last.iterations, ending,
    )  # fmt: skip


def _with_first(first: tuple[Any, ...], more: tuple[Any, ...]) -> list[Array]:
    """Stacks a guess and further guesses."""
    pairs = [(jnp.asarray(one, float), jnp.asarray(others, float)) for one, others in zip(first, more, strict=True)]
    if any(others.shape[1:] != one.shape for one, others in pairs):
        shapes = [others.shape for _, others in pairs]
        raise InputError(f"starts have shapes {shapes}; expected the shape of the guess behind an axis of guesses")
    return [jnp.concatenate([one[None], others]) for one, others in pairs]


def _best(solutions: Shooting) -> Shooting:
    """Returns the solution of least objective, or that of least violation if all violate hard constraints."""
    keys = solutions.objective, jnp.maximum(solutions.violation, solutions.feasibility)
    objective, off = (jnp.where(jnp.isfinite(key), key, jnp.inf) for key in keys)
    best = jnp.where(jnp.isfinite(objective).any(), jnp.argmin(objective), jnp.argmin(off))
    return jax.tree.map(lambda leaf: leaf[best], solutions)


def _inside(guess: Array, lower: Any, upper: Any, name: str) -> Array:
    """Moves a guess inside its limits, by at most a hundredth of their range."""
    if not any(isinstance(limit, Tracer) for limit in (lower, upper)):
        low, high = np.broadcast_arrays(np.asarray(lower, float), np.asarray(upper, float))
        if crossed := np.flatnonzero(~(low < high)).tolist():
            raise InputError(f"limits {crossed} of the {name} are not in order; expected lower < upper")
    low, high = (jnp.asarray(limit, guess.dtype) for limit in (lower, upper))
    margin = jnp.minimum(1e-2 * (high - low), jnp.inf)
    one_low, one_high = (1e-2 * jnp.maximum(1.0, jnp.abs(limit)) for limit in (low, high))
    low = jnp.where(jnp.isfinite(low), low + jnp.minimum(one_low, margin), low)
    high = jnp.where(jnp.isfinite(high), high - jnp.minimum(one_high, margin), high)
    return jnp.clip(guess, low, high)
