"""Optimality conditions of a trajectory: constraints as one vector, derivatives by stage, residuals.

    L = sum_k l(x_k, u_k) + l_N(x_N) + sum_k λ_{k+1}·(f(x_k, u_k) - x_{k+1}) + z·c + ν·h(x_N),   c <= 0, h = 0

c stacks limits of controls, path constraints, limits of states and constraints on states, first for the steps, then for
the end. Limits and constraints of the first state are left out: no control changes them. The rows h and -h follow; they
replace h = 0 where violations are minimised.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import Bool, Float

from dln_jax.control.riccati import Horizon
from dln_jax.control.trajectories import TrajectoryProblem, knots_of

Rows = Callable[..., Array]


class Values(NamedTuple):
    """Cost and constraints of a trajectory."""

    cost: Float[Array, ""]
    c: Float[Array, " M"]
    """Inequalities, negative inside, then h and -h."""
    defects: Float[Array, "N n"]
    h: Float[Array, " q"]
    """Equations of the end."""


class Slopes(NamedTuple):
    """First derivatives."""

    steps: Float[Array, "N n n+m"]
    cost: Float[Array, "N n+m"]
    end_cost: Float[Array, " n"]
    rows: Float[Array, "N P n+m"]
    end_rows: Float[Array, "E n"]
    h: Float[Array, "q n"]


class Kinds(NamedTuple):
    """Masks of the inequalities."""

    present: Bool[Array, " M"]
    """Finite limits and all constraints, except those on the first state."""
    soft: Bool[Array, " M"]
    unknowns: Bool[Array, " M"]
    """Limits of the controls and of the free components of the states, such as a duration."""


def _beyond(lower: Any, upper: Any) -> tuple[Rows, Callable[[int], Array]]:
    """Returns y -> distances beyond the finite limits, and size of y -> mask of the finite ones."""

    def sides(size: int) -> list[tuple[int, Any, np.ndarray]]:
        chosen = []
        for sign, limit in ((-1, lower), (1, upper)):
            # Traced limits may turn out to be infinite; their rows are then masked.
            traced = isinstance(limit, Tracer)
            index = np.arange(size) if traced else np.flatnonzero(np.broadcast_to(np.isfinite(limit), size))
            chosen.append((sign, jnp.broadcast_to(jnp.asarray(limit, float), size)[index], index))
        return chosen

    def rows(y: Array) -> Array:
        finite = [(sign, jnp.where(jnp.isfinite(limit), limit, 0.0), i) for sign, limit, i in sides(len(y))]
        return jnp.concatenate([sign * (y[index] - limit) for sign, limit, index in finite])

    return rows, lambda size: jnp.concatenate([jnp.isfinite(limit) for _, limit, _ in sides(size)])


def constraints(problem: TrajectoryProblem, n: int, m: int) -> tuple[Rows, Rows, Callable[[int], Kinds]]:
    """Returns (x, u) -> rows [P] of a step, x -> rows [E] of the end, and N -> the masks of all M rows.

    The rows of a step are limits of the controls, `path`, limits of the states and `states`.
    """
    of_u, finite_u = _beyond(problem.lower, problem.upper)
    of_x, finite_x = _beyond(problem.lower_x, problem.upper_x)
    _, last = knots_of(problem)

    def on_state(x: Array, *knot: Any) -> list[Array]:
        return [of_x(x), *([problem.states(x, *knot)] if problem.states else [])]

    def step_rows(x: Array, u: Array, *knot: Any) -> Array:
        path = [problem.path(x, u, *knot)] if problem.path else []
        return jnp.concatenate([of_u(u), *path, *on_state(x, *knot)])

    def end_rows(x: Array, *knot: Any) -> Array:
        return jnp.concatenate([*on_state(x, *knot), *([problem.end_below(x, *knot)] if problem.end_below else [])])

    def size(function: Any, *shapes: int) -> int:
        return jax.eval_shape(function, *(jnp.zeros(shape) for shape in shapes), *last).shape[0] if function else 0

    def kinds(steps: int) -> Kinds:
        limits_u, limits_x = finite_u(m), finite_x(n)
        free = jnp.zeros(n) if problem.free is None else jnp.asarray(problem.free, float)
        # Rows that change with the free components.
        free = jax.jvp(of_x, (jnp.zeros(n),), (free,))[1] != 0
        path, states, end = size(problem.path, n, m), size(problem.states, n), size(problem.end_below, n)
        yes, no = (lambda number: jnp.ones(number, bool)), (lambda number: jnp.zeros(number, bool))
        u, x = len(limits_u), len(limits_x)

        def every(of_step: list[Array], of_end: list[Array]) -> Array:
            rows = jnp.tile(jnp.concatenate(of_step), (steps, 1)).at[0, u + path :].set(False)
            return jnp.concatenate([rows.ravel(), *of_end])

        return Kinds(
            every([limits_u, yes(path), limits_x, yes(states)], [limits_x, yes(states + end)]),
            every([no(u), yes(path), no(x), yes(states)], [no(x), yes(states + end)]),
            every([yes(u), no(path), free, no(states)], [free, no(states + end)]),
        )

    return step_rows, end_rows, kinds


class Conditions(NamedTuple):
    """Functions of a trajectory x [N+1, n], u [N, m], whose cost is multiplied by a scale."""

    values: Callable[[Array, Array], Values]
    slopes: Callable[[Array, Array], Slopes]
    curvatures: Callable[[Array, Array, Array, Array, Array], tuple[Array, Array]]
    """(x, u, prices, z, nu) -> Hessians of L for the steps [N, n+m, n+m] and the end [n, n]."""
    kinds: Kinds
    """Masks of all rows except the last, h and -h."""


def conditions(
    problem: TrajectoryProblem, shape: tuple[int, int, int], scale: Array, exact: bool, held: Array
) -> Conditions:
    """Returns the functions for N steps with n states and m controls.

    Unless `exact`, only costs have curvature (Gauss-Newton). `held` is one, or zero if the rows h and -h replace h = 0.
    """
    steps, n, m = shape
    step_rows, below, kinds = constraints(problem, n, m)
    end = problem.end if problem.end is not None else (lambda x, *knot: jnp.zeros(0, x.dtype))
    knots, last = knots_of(problem)

    def of_both(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda xu, *rest: function(xu[:n], xu[n:], *rest)

    def equal(x: Array, *knot: Any) -> Array:
        return held * end(x, *knot)

    def end_rows(x: Array, *knot: Any) -> Array:
        h = end(x, *knot)
        return jnp.concatenate([below(x, *knot), h, -h])

    def cost(x: Array, u: Array, *knot: Any) -> Array:
        return scale * problem.cost(x, u, *knot)

    def end_cost(x: Array) -> Array:
        return scale * problem.final_cost(x, *last)

    def values(x: Array, u: Array) -> Values:
        rows = jax.vmap(step_rows)(x[:-1], u, *knots)
        defects = jax.vmap(problem.step)(x[:-1], u, *knots) - x[1:]
        total = jnp.sum(jax.vmap(cost)(x[:-1], u, *knots)) + end_cost(x[-1])
        return Values(total, jnp.concatenate([rows.ravel(), end_rows(x[-1], *last)]), defects, equal(x[-1], *last))

    def slopes(x: Array, u: Array) -> Slopes:
        both = jnp.concatenate([x[:-1], u], axis=1)
        steps, cost_slopes, rows = (
            jax.vmap(derivative(of_both(function)))(both, *knots)
            for derivative, function in ((jax.jacfwd, problem.step), (jax.grad, cost), (jax.jacfwd, step_rows))
        )
        of_end = jax.grad(end_cost)(x[-1]), jax.jacfwd(end_rows)(x[-1], *last), jax.jacfwd(equal)(x[-1], *last)
        return Slopes(steps, cost_slopes, of_end[0], rows, *of_end[1:])

    def of_stage(x: Array, u: Array, price: Array, z: Array, *knot: Any) -> Array:
        if not exact:
            return cost(x, u, *knot)
        return cost(x, u, *knot) + price @ problem.step(x, u, *knot) + z @ step_rows(x, u, *knot)

    def of_end(x: Array, z: Array, nu: Array) -> Array:
        return end_cost(x) + z @ end_rows(x, *last) + nu @ equal(x, *last) if exact else end_cost(x)

    def curvatures(x: Array, u: Array, prices: Array, z: Array, nu: Array) -> tuple[Array, Array]:
        both, (by_step, at_end) = jnp.concatenate([x[:-1], u], axis=1), split(z, steps, end_size)
        of_steps = jax.vmap(jax.hessian(of_both(of_stage)))(both, prices, by_step, *knots)
        return of_steps, jax.hessian(of_end)(x[-1], at_end, nu)

    end_size = jax.eval_shape(end_rows, jnp.zeros(n), *last).shape[0]
    return Conditions(values, slopes, curvatures, kinds(steps))


def split(rows: Array, steps: int, end_size: int) -> tuple[Array, Array]:
    """Splits a vector [M] into the rows of the steps [N, P] and those of the end [E]."""
    cut = len(rows) - end_size
    return rows[:cut].reshape(steps, -1), rows[cut:]


def along(slopes: Slopes, dx: Array, du: Array) -> tuple[Array, Array, Array]:
    """Returns the directional derivatives of the cost, of c [M] and of h [q]."""
    both = jnp.concatenate([dx[:-1], du], axis=1)
    of_cost = jnp.sum(slopes.cost * both) + slopes.end_cost @ dx[-1]
    rows = jnp.einsum("kpi,ki->kp", slopes.rows, both)
    return of_cost, jnp.concatenate([rows.ravel(), slopes.end_rows @ dx[-1]]), slopes.h @ dx[-1]


def stationarity(slopes: Slopes, prices: Array, z: Array, nu: Array, free: Any) -> Array:
    """Returns the gradient of L by all unknowns, zero for a fixed first state."""
    n, steps = slopes.steps.shape[1], len(slopes.steps)
    by_step, at_end = split(z, steps, len(slopes.end_rows))
    both = slopes.cost + jnp.einsum("kij,ki->kj", slopes.steps, prices) + jnp.einsum("kpj,kp->kj", slopes.rows, by_step)
    end = slopes.end_cost + slopes.end_rows.T @ at_end + slopes.h.T @ nu
    by_x = jnp.concatenate([both[:, :n], end[None]]).at[1:].add(-prices)
    first = by_x[0] * (0.0 if free is None else jnp.asarray(free))
    return jnp.concatenate([by_x.at[0].set(first).ravel(), both[:, n:].ravel()])


def program(
    slopes: Slopes, curvatures: tuple[Array, Array], gradient: Array, weight: Array, missed: Array, damping: Any
) -> Horizon:
    """Returns the quadratic program of a step, with `gradient` and `weight` [M] on the inequalities, and damping."""
    n, steps = slopes.steps.shape[1], len(slopes.steps)
    (by_step, at_end), (stiff, stiff_end) = (split(rows, steps, len(slopes.end_rows)) for rows in (gradient, weight))
    of_steps = curvatures[0] + jnp.einsum("kpi,kp,kpj->kij", slopes.rows, stiff, slopes.rows)
    of_end = curvatures[1] + slopes.end_rows.T @ (stiff_end[:, None] * slopes.end_rows)
    return Horizon(
        slopes.steps, missed, slopes.cost + jnp.einsum("kpj,kp->kj", slopes.rows, by_step),
        of_steps + damping * jnp.eye(of_steps.shape[1]), slopes.end_cost + slopes.end_rows.T @ at_end,
        of_end + damping * jnp.eye(n),
    )  # fmt: skip
