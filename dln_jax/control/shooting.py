"""Optimal trajectories with constraints, by multiple or single shooting and an interior-point method.

    min  sum_k l(x_k, u_k) + l_N(x_N),   x_{k+1} = f(x_k, u_k),   c <= 0,   h(x_N) = 0

Multiple shooting takes the states at all knots as unknowns. The defect of a step, f(x_k, u_k) - x_{k+1}, vanishes only
at the solution: a guess need not be a motion, and an unstable system does not amplify its errors over the horizon (Bock
and Plitt 1984). Single shooting changes the controls alone: each trial is a motion under the gains of the step, so it
cannot get stuck between states that no motion joins. Both methods use the full curvature, including the curvature of
the steps. Implicit steps from `integrated` are differentiated by the implicit function theorem.
"""

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import Bool, Float, Int

from dln_jax.control.conditions import Conditions, Iterate, conditions
from dln_jax.control.constraints import require_end, require_start
from dln_jax.control.phases import gave_up, phases
from dln_jax.control.riccati import HorizonSolution
from dln_jax.control.trajectories import FIRST_DAMPING, Plan, TrajectoryProblem, first_plan, followed, knots_of
from dln_jax.solvers.ending import Ending, reason
from dln_jax.types import InputError, require_positive

HELD = 100.0
"""A constraint holds if its excess is at most this many tolerances: 1e-6 by default."""
LARGEST_GRADIENT = 100.0
"""The cost is scaled so that its derivatives at the guess do not exceed this."""


class Shooting(NamedTuple):
    """Result of `shoot`."""

    plan: Plan
    """Plan for `mpc` and for feedback along it; its states at the knots form a motion to within the defect."""
    multipliers: Float[Array, "N n"]
    """Derivatives of the cost to go by the states at the ends of the steps."""
    end_multipliers: Float[Array, " q"]
    """Multipliers of the equations of the end."""
    pressures: Float[Array, " M"]
    """Multipliers of the inequalities, not negative, in the order of `control.constraints`."""
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
    single: Bool[Array, ""]
    """True if single shooting found the plan."""

    @property
    def converged(self) -> Bool[Array, ""]:
        """True if all optimality conditions hold within the tolerance, and all constraints within 100 times the
        tolerance.

        Otherwise `verdict` gives the reason.
        """
        return self.ending == Ending.CONVERGED

    @property
    def verdict(self) -> str:
        """Sentence with the method that found the plan and the end of its search."""
        return f"{'single' if self.single else 'multiple'} shooting {reason(self.ending)}"


def shoot(
    problem: TrajectoryProblem,
    x: Any,
    states: Any,
    u: Any,
    *,
    method: Literal["multiple", "single"] | None = None,
    iterations: int = 300,
    tolerance: float = 1e-8,
    exact: bool = True,
    starts: tuple[Any, Any] | None = None,
) -> Shooting:
    """Returns a locally optimal trajectory near a guess; traceable.

    The search leaves saddles. If it gives up with violated hard constraints, another search restores them or shows that
    the problem is locally infeasible (see `control.phases`). A plan with `Ending.INFEASIBLE` has the least violation
    nearby; its residuals and multipliers belong to the sum of violations.

    Args:
        problem: problem to solve.
        x: initial state [n].
        states: guess [N+1, n], which need not be a motion; x replaces its first state, except for free components.
            `None` for the motion under u; single shooting always starts with it.
        u: guess [N, m].
        method: by default multiple shooting, and if it fails, single shooting from the same controls. The plan then
            comes from single shooting if that converged.
        iterations: largest number of iterations per search. Leaving a saddle and restoring constraints are separate
            searches.
        tolerance: tolerance of stationarity, feasibility and complementarity, with the cost scaled so that its
            derivatives at the guess are at most 100. Stationarity and complementarity are divided by a hundredth of the
            mean multiplier if this exceeds one.
        exact: use the curvature of the steps and constraints. Otherwise the method is Gauss-Newton, which does not
            recognise saddles.
        starts: more guesses, states [G, N+1, n] or `None`, and u [G, N, m]. All run as one program. The best has the
            least objective within the hard constraints, or otherwise the least violation.

    Raises:
        InputError: shapes do not agree, a setting is not positive, limits are crossed, the start violates the limits of
            the states or their constraints, or these limits exclude a linear constraint of the end.
    """
    require_positive(iterations=iterations, tolerance=tolerance)
    if method not in (None, "multiple", "single"):
        raise InputError(f"method is {method!r}; expected 'multiple', 'single', or None for both in turn")
    start, x, u = x, jnp.asarray(x, float), jnp.asarray(u, float)
    states = None if states is None or method == "single" else jnp.asarray(states, float)
    if x.ndim != 1 or u.ndim != 2 or not len(u) or (states is not None and states.shape != (len(u) + 1, len(x))):
        shape = None if states is None else states.shape
        raise InputError(f"x has shape {x.shape}, states {shape}, u {u.shape}; expected [n], [N+1, n] and [N, m]")
    require_start(problem, start, u.shape[1])
    require_end(problem, len(x), u.shape[1])
    free = jnp.zeros(len(x), bool) if problem.free is None else jnp.asarray(problem.free)
    guesses = (states, u) if starts is None else _with_first(states, u, *starts)

    def one(single: Any, states: Any, u: Array) -> Shooting:
        u = _inside(u, problem.lower, problem.upper, "controls")
        knots = None
        if states is not None:
            knots = _inside(states, problem.lower_x, problem.upper_x, "states")
            knots = knots.at[0].set(jnp.where(free, knots[0], x))
        if knots is None or method is None:
            motion = first_plan(problem, x, u).x
            knots = motion if knots is None else jnp.where(single, motion, knots)
        return _solved(problem, knots, u, single, method, (iterations, tolerance, exact))

    def best(single: Any) -> Shooting:
        if starts is None:
            return one(single, *guesses)
        plans = jax.vmap(lambda *guess: one(single, *guess))(*guesses)
        # The least objective, or the least violation if all violate hard constraints.
        keys = plans.objective, jnp.maximum(plans.violation, plans.feasibility)
        objective, off = (jnp.where(jnp.isfinite(key), key, jnp.inf) for key in keys)
        chosen = jnp.where(jnp.isfinite(objective).any(), jnp.argmin(objective), jnp.argmin(off))
        return jax.tree.map(lambda leaf: leaf[chosen], plans)

    if method is not None:
        return best(jnp.asarray(method == "single"))
    best = jax.jit(best)  # traced once, for its shapes and for both attempts

    def failed(plan: Shooting) -> Array:
        return (plan.ending != Ending.CONVERGED) & (plan.ending != Ending.EXCEEDED)

    def attempt(state: tuple[Array, Shooting]) -> tuple[Array, Shooting]:
        number, before = state
        plan = best(number == 1)
        replaced = (number == 0) | ~failed(plan)
        return number + 1, jax.tree.map(lambda new, old: jnp.where(replaced, new, old), plan, before)

    none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(best, jnp.asarray(False)))
    none = none._replace(ending=jnp.asarray(Ending.UNDECIDED))
    return jax.lax.while_loop(lambda state: (state[0] < 2) & failed(state[1]), attempt, (jnp.asarray(0), none))[1]


def _solved(
    problem: TrajectoryProblem, x: Array, u: Array, single: Any, method: Any, settings: tuple[int, float, bool]
) -> Shooting:
    iterations, tolerance, exact = settings
    shape, (knots, last_knot) = (len(u), x.shape[1], u.shape[1]), knots_of(problem)

    def cost(x: Array, u: Array) -> Array:
        return jnp.sum(jax.vmap(problem.cost)(x[:-1], u, *knots)) + problem.final_cost(x[-1], *last_knot)

    gradients = jax.grad(cost, argnums=(0, 1))(x, u)
    scale = jnp.maximum(jnp.max(jnp.abs(jnp.concatenate([g.ravel() for g in gradients]))) / LARGEST_GRADIENT, 1.0)
    scale = jnp.where(jnp.isfinite(scale), scale, 1.0)

    def of(weight: Array, held: Array) -> Conditions:
        return conditions(problem, shape, weight / scale, exact, held)

    def straight(at: Iterate, change: HorizonSolution, length: Array) -> tuple[Array, Array]:
        """Moves states and controls along the change."""
        return at.x + length * change.dx, at.u + length * change.du

    def motion(at: Iterate, change: HorizonSolution, length: Array) -> tuple[Array, Array]:
        """Returns the motion under the gains of the step."""
        k = length * (change.du - jnp.einsum("kij,kj->ki", change.K, change.dx[:-1]))
        first = at.x[0] + length * change.dx[0]
        return followed(problem, first, (at.x[:-1], at.u, k, change.K), lambda u, _: u)

    def either(*arguments: Any) -> tuple[Array, Array]:
        return jax.lax.cond(single, motion, straight, *arguments)

    trial = {"multiple": straight, "single": motion, None: either}[method]
    w_1, w_2 = problem.soft or (0.0, 0.0)
    soft = None if problem.soft is None else (w_1 / scale, w_2 / scale)
    last, weight = phases(of, trial, x, u, soft=soft, free=problem.free, iterations=iterations, tolerance=tolerance)

    at, values, residuals, kinds = last.at, last.values, last.residuals, of(jnp.ones(()), jnp.ones(())).kinds
    ended = jnp.split(at.z[len(at.z) - 2 * len(at.nu) :], 2)
    pressures = at.z[: len(at.z) - 2 * len(at.nu)]
    excess = jnp.where(kinds.present, jnp.maximum(values.c, 0.0), 0.0)
    violation = jnp.max(excess, initial=0.0)
    outside = gave_up(last.ending) & (residuals.feasibility > jnp.sqrt(tolerance))
    exceeded = (last.ending == Ending.CONVERGED) & (violation > HELD * tolerance)
    ending = jnp.select([outside, exceeded], [Ending.VIOLATED, Ending.EXCEEDED], last.ending)
    scale = scale / weight
    objective = scale * values.cost + jnp.sum(jnp.where(kinds.soft, w_1 * excess + w_2 / 2 * excess**2, 0.0))
    # After a search that minimised violations, feasibility does not count them.
    held = (weight == 1) & (residuals.feasibility <= HELD * tolerance)
    damping = jnp.asarray(FIRST_DAMPING, at.u.dtype)
    return Shooting(
        Plan(at.u, at.x, last.change.K, scale * values.cost, damping, jnp.asarray(True), ending),
        scale * at.prices,
        scale * (at.nu + ended[0] - ended[1]),
        scale * pressures,
        jnp.max(jnp.abs(values.defects)),
        violation,
        jnp.where(held, objective, jnp.inf),
        *residuals,
        scale,
        last.iterations,
        ending,
        jnp.asarray(single),
    )


def _with_first(states: Any, u: Array, more_states: Any, more_u: Any) -> tuple[Any, Array]:
    """Stacks a guess and further guesses; without states, the states of the others are ignored."""

    def both(one: Array, others: Any) -> Array:
        others = jnp.asarray(others, float)
        if others.shape[1:] != one.shape:
            raise InputError(f"starts have shape {others.shape}; expected {one.shape} with a leading axis of guesses")
        return jnp.concatenate([one[None], others])

    return None if states is None else both(states, more_states), both(u, more_u)


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
