"""Model predictive control with constraints in real time: one iteration per sample, with a fixed number of operations.

At a sample, `feedback` computes the control from the measured state and the gains of the plan, by one matrix-vector
product. Until the next sample, `prepare` follows the plan from the measured state, shifts it by a step, and improves it
by an iteration of single shooting. The split follows Diehl, Bock and Schlöder (2005). The iteration solves a smooth
problem, with barriers for the limits of the controls and prices for all other constraints c <= 0:

    -μ log(-c)   and   min_t  w_1 t - μ log t - μ log(t - c)  +  w_2 max(c, 0)² / 2

Barriers keep controls inside their limits. Prices are the costs of soft constraints with slacks (Fiacco and McCormick
1968): as μ falls, the minimum approaches w_1 max(c, 0), which is exact where the multiplier is below w_1. With h = μ /
w_1 and the smoothed distance d = (√(c² + 4 h²) - c) / 2 the slope is μ / (d + h); a barrier has h = 0 and d = -c. These
slopes act at any distance, so a far obstacle would move the plan away from its goal. A factor (1 - d / D)² makes them
zero beyond a distance D: a tenth of the range of a limit, or 0.1 in the units of any other constraint. Every sample
then has a plan that needs no memory of multipliers and states whether it violates a constraint.

An iteration is a Gauss-Newton step (iterative LQR, Li and Todorov 2004) by Riccati's recursion. It simulates several
step lengths and takes the best. If none lowers the cost, it raises the damping of the Hessian of the controls.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from dln_jax.control.riccati import eliminated, made_convex
from dln_jax.control.state_space import where_finite
from dln_jax.control.trajectories import Plan, TrajectoryProblem, followed, knots_of
from dln_jax.solvers.ending import Ending
from dln_jax.types import InputError, require_positive

STEP_LENGTHS = (1.0, 0.3)
BARRIER = 1e-3
"""Default μ, in units of the cost: a control stays μ / p away from a limit with multiplier p per unit."""
PRICES = 1e3, 1e3
"""Prices (w_1, w_2) of the constraints of problems without `soft`."""
MIN_DAMPING, MAX_DAMPING = 1e-9, 1e9
TO_BOUNDARY, CLOSEST, REACH = 0.99, 1e-5, 0.1
"""Largest share of the distance to a limit in an iteration, least distance from finite limits relative to their range,
and D relative to the range (or to 1 without a range)."""
ROUNDING = 1e-12
"""Relative difference of costs that counts as rounding."""
VIOLATED = 5.0
"""Excess in units of δ that counts as a violation; the multiplier then exceeds nine tenths of the price."""


def feedback(problem: TrajectoryProblem, plan: Plan, x: Any) -> Array:
    """Returns the control [m] of the plan at a measured state [n] near its first state; NaN for a non-finite state."""
    return where_finite(_limited(problem)(plan.u[0] + plan.K[0] @ (x - plan.x[0]), plan.u[0]), jnp.asarray(x, float))


def prepare(
    problem: TrajectoryProblem, plan: Plan, x: Any, *, barrier: Any = BARRIER, iterations: Any = 1,
    step_lengths: Any = STEP_LENGTHS,
) -> Plan:  # fmt: skip
    """Returns the plan for the next sample, after `feedback` at a state [n] was applied.

    Args:
        problem: over the horizon; its knots, if any, have N+2 rows, from this sample to the end of the next horizon.
        plan: the plan used by `feedback`.
        x: measured state. The plan's prediction replaces non-finite components, and `ending` is then `NOT_FINITE`.
        barrier, step_lengths: as for `improve`.
        iterations: number of iterations; it may be traced.

    Raises:
        InputError: as for `improve`.
    """
    if not isinstance(iterations, Tracer):
        require_positive(iterations=iterations)
    seen = jnp.isfinite(jnp.asarray(x, float))
    x = jnp.where(seen, x, plan.x[0])
    now, later = (
        problem._replace(knots=jax.tree.map(lambda rows, part=part: rows[part], problem.knots))
        for part in (slice(None, -1), slice(1, None))
    )

    def under(about: Array, K: Array) -> tuple[Array, Array]:
        return followed(now, x, (about, plan.u, jnp.zeros_like(plan.u), K), _limited(problem))

    states, u = under(plan.x[:-1], plan.K)
    # Gains too large for the deviation, for example after an impact, would make every later plan NaN.
    lost = ~jnp.isfinite(states).all()
    bare = lambda: under(jnp.zeros_like(plan.x[:-1]), jnp.zeros_like(plan.K))  # noqa: E731
    states, u = jax.lax.cond(lost, bare, lambda: (states, u))
    u = jnp.where(jnp.isfinite(u), u, plan.u)  # of states that are not finite
    knot = jax.tree.map(lambda rows: rows[-1], knots_of(later)[0])
    last = problem.step(states[-1], u[-1], *knot)
    moved = plan._replace(
        u=jnp.concatenate([u[1:], u[-1:]]), x=jnp.concatenate([states[1:], last[None]]),
        K=jnp.concatenate([plan.K[1:], plan.K[-1:]]),
    )  # fmt: skip
    again = lambda _, plan: improve(later, plan, barrier=barrier, step_lengths=step_lengths)  # noqa: E731
    # A loop with a single turn would only add code.
    single = not isinstance(iterations, Tracer) and iterations == 1
    after = again(0, moved) if single else jax.lax.fori_loop(0, iterations, again, moved)
    return after._replace(ending=jnp.where(seen.all(), after.ending, Ending.NOT_FINITE))


def mpc(
    problem: TrajectoryProblem, *, barrier: Any = BARRIER, iterations: int = 1, step_lengths: Any = STEP_LENGTHS
) -> Callable[..., tuple[Array, Plan]]:
    """Returns (state, plan) -> (control, plan of the next sample): model predictive control by `feedback` and
    `prepare`.

    Start with a plan of `shoot` or `first_plan`, after a few calls of `improve`. If the problem has knots,
    pass them as a third argument, N+2 rows from the present sample on.

    Args:
        problem: over the horizon.
        barrier, step_lengths: as for `improve`.
        iterations: number of iterations per call.
    """

    def act(x: Any, plan: Plan, knots: Any = None) -> tuple[Array, Plan]:
        now = problem if knots is None else problem._replace(knots=knots)
        after = prepare(now, plan, x, barrier=barrier, iterations=iterations, step_lengths=step_lengths)
        return feedback(problem, plan, x), after

    return act


def improve(
    problem: TrajectoryProblem, plan: Plan, *, barrier: Any = BARRIER, step_lengths: Any = STEP_LENGTHS
) -> Plan:
    """Runs one iteration from the plan's first state; the cost with barriers and prices never rises beyond rounding.

    All constraints except the limits of the controls have the prices `soft` of the problem, by default 1e3. The plan's
    `ending` is `VIOLATED` if the plan violates a constraint (`worst_violation` names it), `NOT_FINITE` if its cost is
    not finite, and otherwise undecided.

    Args:
        problem: over the horizon.
        plan: such as a result of `shoot` or `first_plan`.
        barrier: μ, in units of the cost; it may be traced, to fall from iteration to iteration.
        step_lengths: step lengths [L] to try in an iteration.

    Raises:
        InputError: a component of the first state is free, or the barrier is not positive.
    """
    if not isinstance(barrier, Tracer):
        require_positive(barrier=barrier)
    if problem.free is not None:
        raise InputError("the first state has a free component, but it is measured in real time; leave out `free`")
    n, m = plan.x.shape[1], plan.u.shape[1]
    at_step, at_end = _smooth(problem, n, m, barrier)
    (knots, last), limited = knots_of(problem), _limited(problem)
    u = limited(plan.u, plan.u)

    def total(x: Array, u: Array) -> tuple[Array, Array]:
        """Returns the cost with barriers and prices, and the largest excess."""
        costs, excesses = jax.vmap(at_step.cost)(jnp.concatenate([x[:-1], u], axis=1), *knots)
        end_cost, end_excess = at_end.cost(x[-1], *last)
        return jnp.sum(costs) + end_cost, jnp.maximum(jnp.max(excesses), end_excess)

    def back(value: tuple[Array, Array], stage: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        (g, S), (F, gradient, curvature) = value, stage
        q, Q = gradient + F.T @ g, curvature + F.T @ S @ F
        R = Q[n:, n:] + plan.damping * jnp.mean(jnp.abs(jnp.diagonal(Q[n:, n:]))) * jnp.eye(m, dtype=Q.dtype)
        k, K, before, _ = eliminated(n, q, Q.at[n:, n:].set(made_convex(R)))
        return before, (k, K)

    def trial(length: Array) -> tuple[Array, Array, tuple[Array, Array]]:
        states, controls = followed(problem, plan.x[0], (plan.x[:-1], u, length * k, K), limited)
        return states, controls, total(states, controls)

    both = jnp.concatenate([plan.x[:-1], u], axis=1)
    F = jax.vmap(jax.jacfwd(lambda xu, *knot: problem.step(xu[:n], xu[n:], *knot)))(both, *knots)
    expansions = jax.vmap(at_step.expansion)(both, *knots)
    _, (k, K) = jax.lax.scan(back, at_end.expansion(plan.x[-1], *last), (F, *expansions), reverse=True)
    states, controls, (costs, excesses) = jax.vmap(trial)(jnp.asarray(step_lengths, u.dtype))
    costs, (now, excess) = jnp.where(jnp.isfinite(costs), costs, jnp.inf), total(plan.x, u)
    best = jnp.argmin(costs)
    # A cost equal within rounding counts as better: at the optimum the damping must not grow, and the gains must not
    # vanish.
    better = (costs[best] <= now + ROUNDING * jnp.abs(now)) | (jnp.isfinite(costs[best]) & ~jnp.isfinite(now))
    x, u, cost, excess = (
        jnp.where(better, new[best], old)
        for new, old in ((states, plan.x), (controls, u), (costs, now), (excesses, excess))
    )
    damping = jnp.clip(jnp.where(better, plan.damping / 10, plan.damping * 10), MIN_DAMPING, MAX_DAMPING)
    violated = jnp.where(excess > VIOLATED * _width(problem, barrier), Ending.VIOLATED, Ending.UNDECIDED)
    return Plan(u, x, K, cost, damping, better, jnp.where(jnp.isfinite(cost), violated, Ending.NOT_FINITE))


class _Smooth(NamedTuple):
    """Cost of a step or of the end with barriers and prices, as a function of y = (x, u) or x."""

    cost: Callable[..., tuple[Array, Array]]
    """(y, knot) -> cost, and largest row of the constraints."""
    expansion: Callable[..., tuple[Array, Array]]
    """(y, knot) -> gradient and Gauss-Newton Hessian."""


def _smooth(problem: TrajectoryProblem, n: int, m: int, barrier: Any) -> tuple[_Smooth, _Smooth]:
    """Returns the cost of a step and the cost of the end."""
    w_2, h_price = (PRICES if problem.soft is None else problem.soft)[1], _width(problem, barrier) / 2

    def law(c: Array, h: Any, D: Any) -> tuple[Array, Array, Array]:
        """Returns value, slope and curvature of prices, or of barriers for h = 0."""
        r, beyond = jnp.sqrt(c**2 + 4 * h**2), jnp.maximum(c, 0.0)
        # Without cancellation: (r + c) (r - c) = 4 h².
        d = jnp.where(c >= 0, 2 * h**2 / (r + jnp.abs(c)), (r + jnp.abs(c)) / 2)

        def integral(d: Any) -> Array:
            logs = 2 * (1 + h / D) ** 2 * jnp.log(d + h) - (1 + 2 * h / D) * jnp.log(d)
            return logs - h / d - 2 * d / D + (d / 2 - h) * d / D**2

        fade, steep = jnp.maximum(1 - d / D, 0.0), barrier / (d + h)
        value = barrier * (integral(D) - integral(jnp.minimum(d, D))) + w_2 / 2 * beyond**2
        curvature = d / r * steep * fade * (fade / (d + h) + 2 / D) + jnp.where(c > 0, w_2, 0.0)
        return value, steep * fade**2 + w_2 * beyond, curvature

    def priced(cost: Callable[..., Any], rows: list[Callable[..., Array]], limits: list[tuple[Any, ...]]) -> _Smooth:
        # The derivative of a limit is constant and has one non-zero element.
        boxes = [limit for limit in limits if len(limit[1])]

        def every(y: Array, *knot: Any) -> Array:
            return jnp.concatenate([row(y, *knot) for row in rows])

        def whole(y: Array, *knot: Any) -> tuple[Array, Array]:
            terms = [(signs @ y - bounds, *shape) for signs, bounds, *shape in boxes]
            terms += [(every(y, *knot), h_price, REACH)] if rows else []
            value = cost(y, *knot) + sum(jnp.sum(law(*term)[0]) for term in terms)
            return value, jnp.max(jnp.concatenate([jnp.full(1, -jnp.inf), *(c for c, *_ in terms)]))

        def expansion(y: Array, *knot: Any) -> tuple[Array, Array]:
            gradient, hessian = jax.grad(cost)(y, *knot), jax.hessian(cost)(y, *knot)
            for signs, bounds, *shape in boxes:
                _, slope, curvature = law(signs @ y - bounds, *shape)
                gradient, hessian = gradient + signs.T @ slope, hessian + jnp.diag(jnp.abs(signs).T @ curvature)
            if rows:
                _, slope, curvature = law(every(y, *knot), h_price, REACH)
                J = jax.jacfwd(every)(y, *knot)
                gradient, hessian = gradient + J.T @ slope, hessian + J.T @ (curvature[:, None] * J)
            return gradient, hessian

        return _Smooth(whole, expansion)

    def of_state(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda y, *knot: function(y[:n], *knot)

    def of_both(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda y, *knot: function(y[:n], y[n:], *knot)

    states = [of_state(problem.states)] if problem.states else []
    path = [of_both(problem.path)] if problem.path else []
    on_end = [problem.end_below] if problem.end_below else []
    if end := problem.end:
        on_end += [end, lambda x, *knot: -end(x, *knot)]
    signs, bounds, reach = _limits(problem.lower_x, problem.upper_x, n)
    signs_u, *barriers = _limits(problem.lower, problem.upper, m)
    on_step = [
        (np.pad(signs, ((0, 0), (0, m))), bounds, h_price, reach),
        (np.pad(signs_u, ((0, 0), (n, 0))), barriers[0], 0.0, barriers[1]),
    ]
    return (
        priced(of_both(problem.cost), path + states, on_step),
        priced(problem.final_cost, states + on_end, [(signs, bounds, h_price, reach)]),
    )


def _limits(lower: Any, upper: Any, size: int) -> tuple[np.ndarray, Array, Array]:
    """Returns signs [r, size], bounds [r] and D [r] of finite limits, signs y <= bounds; traced limits count as
    finite."""
    sides = []
    for sign, limit in ((-1.0, lower), (1.0, upper)):
        known = np.ones(size, bool) if isinstance(limit, Tracer) else np.isfinite(np.broadcast_to(limit, size))
        bounds, ranges = (jnp.broadcast_to(y, size)[np.flatnonzero(known)] for y in (limit, _range(lower, upper)))
        sides.append((sign * np.eye(size)[known], sign * bounds, REACH * ranges))
    signs, bounds, reach = zip(*sides, strict=True)
    return np.concatenate(signs), jnp.concatenate(bounds), jnp.concatenate(reach)


def _range(lower: Any, upper: Any) -> Array:
    """Returns the range between limits, one where it is not finite."""
    size = jnp.asarray(upper, float) - jnp.asarray(lower, float)
    return jnp.where(jnp.isfinite(size), size, 1.0)


def _limited(problem: TrajectoryProblem) -> Callable[[Array, Array], Array]:
    """Returns (control, previous control) -> control within its limits, at most `TO_BOUNDARY` of the way to them."""
    lower, upper = (jnp.asarray(limit, float) for limit in (problem.lower, problem.upper))
    closest = CLOSEST * _range(lower, upper)

    def limited(u: Array, before: Array) -> Array:
        low = jnp.maximum(lower + closest, before - TO_BOUNDARY * (before - lower))
        return jnp.clip(u, low, jnp.minimum(upper - closest, before + TO_BOUNDARY * (upper - before)))

    return limited


def _width(problem: TrajectoryProblem, barrier: Any) -> Any:
    """Returns δ, the width of the smooth rise of a price."""
    return 2 * barrier / (PRICES if problem.soft is None else problem.soft)[0]
