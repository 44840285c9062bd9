"""Optimality conditions of a trajectory, and Newton steps of an interior-point method on them.

    L = sum_k l(x_k, u_k) + l_N(x_N) + sum_k λ_{k+1}·(f(x_k, u_k) - x_{k+1}) + z·c + ν·h(x_N),   c <= 0, h = 0

c is ordered as in `control.constraints`. An inequality c - t + s = 0 has a slack s > 0 with multiplier z. A soft
inequality also has an excess t > 0 with multiplier y, at the cost w_1 t + w_2 t² / 2. The conditions s z = μ and t y =
μ eliminate slacks and excesses, which leaves a quadratic program over the horizon.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from dln_jax.control.constraints import Kinds, kinds_of, rows_of, stacked
from dln_jax.control.riccati import Horizon, HorizonSolution, least_cost
from dln_jax.control.trajectories import TrajectoryProblem, knots_of

END_COMPLIANCE = 1e-8
"""Regularisation of the end equations in the linear systems; it does not change the solution."""


class Values(NamedTuple):
    """Cost and constraints of a trajectory."""

    cost: Float[Array, ""]
    c: Float[Array, " M"]
    """Inequalities, negative inside, in the order of `control.constraints`."""
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


class Conditions(NamedTuple):
    """Functions of a trajectory x [N+1, n], u [N, m], with the cost multiplied by a scale."""

    values: Callable[[Array, Array], Values]
    slopes: Callable[[Array, Array], Slopes]
    curvatures: Callable[[Array, Array, Array, Array, Array], tuple[Array, Array]]
    """(x, u, prices, z, nu) -> Hessians of L for the steps [N, n+m, n+m] and the end [n, n]."""
    kinds: Kinds


def conditions(
    problem: TrajectoryProblem, shape: tuple[int, int, int], scale: Array, exact: bool, held: Array
) -> Conditions:
    """Returns the functions for N steps with n states and m controls.

    Unless `exact`, only costs have curvature (Gauss-Newton). `held` is one, or zero if the rows h and -h replace h = 0.
    """
    steps, n, m = shape
    step_rows, end_rows = (stacked(rows) for rows in rows_of(problem, n, m))
    end = problem.end if problem.end is not None else (lambda x, *knot: jnp.zeros(0, x.dtype))
    knots, last = knots_of(problem)

    def of_both(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda xu, *rest: function(xu[:n], xu[n:], *rest)

    def equal(x: Array, *knot: Any) -> Array:
        return held * end(x, *knot)

    def cost(x: Array, u: Array, *knot: Any) -> Array:
        return scale * problem.cost(x, u, *knot)

    def end_cost(x: Array) -> Array:
        return scale * problem.final_cost(x, *last)

    def values(x: Array, u: Array) -> Values:
        rows = jax.vmap(step_rows)(x[:-1], u, *knots)
        defects = jax.vmap(problem.step)(x[:-1], u, *knots) - x[1:]
        total = jnp.sum(jax.vmap(cost)(x[:-1], u, *knots)) + end_cost(x[-1])
        return Values(
            total, jnp.concatenate([rows.ravel(), end_rows(x[-1], None, *last)]), defects, equal(x[-1], *last)
        )

    def slopes(x: Array, u: Array) -> Slopes:
        both = jnp.concatenate([x[:-1], u], axis=1)
        steps, cost_slopes, rows = (
            jax.vmap(derivative(of_both(function)))(both, *knots)
            for derivative, function in ((jax.jacfwd, problem.step), (jax.grad, cost), (jax.jacfwd, step_rows))
        )
        of_end = jax.grad(end_cost)(x[-1]), jax.jacfwd(end_rows)(x[-1], None, *last), jax.jacfwd(equal)(x[-1], *last)
        return Slopes(steps, cost_slopes, of_end[0], rows, *of_end[1:])

    def of_stage(x: Array, u: Array, price: Array, z: Array, *knot: Any) -> Array:
        if not exact:
            return cost(x, u, *knot)
        return cost(x, u, *knot) + price @ problem.step(x, u, *knot) + z @ step_rows(x, u, *knot)

    def of_end(x: Array, z: Array, nu: Array) -> Array:
        return end_cost(x) + z @ end_rows(x, None, *last) + nu @ equal(x, *last) if exact else end_cost(x)

    def curvatures(x: Array, u: Array, prices: Array, z: Array, nu: Array) -> tuple[Array, Array]:
        both, (by_step, at_end) = jnp.concatenate([x[:-1], u], axis=1), split(z, steps, end_size)
        of_steps = jax.vmap(jax.hessian(of_both(of_stage)))(both, prices, by_step, *knots)
        return of_steps, jax.hessian(of_end)(x[-1], at_end, nu)

    end_size = jax.eval_shape(end_rows, jnp.zeros(n), None, *last).shape[0]
    return Conditions(values, slopes, curvatures, kinds_of(problem, shape))


def split(rows: Array, steps: int, end_size: int) -> tuple[Array, Array]:
    """Splits a vector [M] into rows of the steps [N, P] and rows of the end [E]."""
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


class Inequalities(NamedTuple):
    """Masks [M] and weights of the inequalities."""

    present: Array
    elastic: Array
    """Soft inequalities."""
    strict: Array
    """Limits of controls and durations, which every iterate respects."""
    linear: Any
    square: Any


class Iterate(NamedTuple):
    """Unknowns and multipliers."""

    x: Array
    u: Array
    prices: Array
    """λ [N, n]."""
    nu: Array
    s: Array
    z: Array
    t: Array
    y: Array


class Residuals(NamedTuple):
    """Largest absolute residuals of the optimality conditions."""

    stationarity: Array
    feasibility: Array
    complementarity: Array

    def largest(self) -> Array:
        """Returns the largest of the three."""
        return jnp.max(jnp.stack(self))


def gaps(of: Inequalities, at: Iterate, values: Values) -> Array:
    """Returns the residuals c - t + s of the inequalities."""
    return jnp.where(of.present, values.c + at.s - at.t, 0.0)


def measure(of: Inequalities, at: Iterate, values: Values, barrier: Array) -> tuple[Array, Array]:
    """Returns the sum of the violations, and the barrier function, infinite if it is not a finite number."""
    violation = jnp.sum(jnp.abs(jnp.concatenate([values.defects.ravel(), values.h, gaps(of, at, values)])))
    price = of.linear * at.t + of.square * at.t**2 / 2 - barrier * jnp.log(at.t)
    phi = values.cost - barrier * jnp.sum(jnp.where(of.present, jnp.log(at.s), 0.0))
    phi = phi + jnp.sum(jnp.where(of.elastic, price, 0.0))
    return violation, jnp.where(jnp.isfinite(phi), phi, jnp.inf)


def slope(of: Inequalities, at: Iterate, slopes: Slopes, step: Iterate, barrier: Array) -> Array:
    """Returns the derivative of the barrier function along a step."""
    fall = along(slopes, step.x, step.u)[0] - barrier * jnp.sum(jnp.where(of.present, step.s / at.s, 0.0))
    return fall + jnp.sum(jnp.where(of.elastic, (of.linear + of.square * at.t - barrier / at.t) * step.t, 0.0))


def residuals(
    of: Inequalities, at: Iterate, values: Values, slopes: Slopes, barrier: Any, free: Any
) -> tuple[Residuals, Residuals]:
    """Returns the residuals at a barrier, plain and divided by 1/100 of the mean multiplier if that is above one."""
    gradient = stationarity(slopes, at.prices, at.z, at.nu, free)
    products = jnp.where(of.present, at.s * at.z - barrier, 0.0)
    gradient = jnp.append(gradient, jnp.where(of.elastic, of.linear + of.square * at.t - at.z - at.y, 0.0))
    products = jnp.append(products, jnp.where(of.elastic, at.t * at.y - barrier, 0.0))
    unmet = jnp.concatenate([values.defects.ravel(), values.h, gaps(of, at, values)])
    plain = Residuals(*(jnp.max(jnp.abs(r), initial=0.0) for r in (gradient, unmet, products)))
    of_rows, number = jnp.sum(at.z) + jnp.sum(at.y), jnp.maximum(jnp.sum(of.present), 1)
    every = jnp.sum(jnp.abs(at.prices)) + jnp.sum(jnp.abs(at.nu)) + of_rows
    scale = jnp.maximum(every / (at.prices.size + at.nu.size + number) / 100, 1.0)
    scale_z = jnp.maximum(of_rows / number / 100, 1.0)
    return plain, Residuals(plain[0] / scale, plain[1], plain[2] / scale_z)


def newton(
    of: Inequalities, at: Iterate, slopes: Slopes, curvatures: tuple[Array, Array], barrier: Array, unmet: Values,
    gap: Array, damping: Array, free: Any,
) -> tuple[HorizonSolution, Iterate]:  # fmt: skip
    """Returns the Newton step, as a solution of the quadratic program and as a change of the iterate."""
    stiff = at.z / at.s
    drive = jnp.where(of.present, barrier / at.s, 0.0) - at.z + stiff * gap
    give = jnp.where(of.elastic, 1 / (of.square + at.y / at.t), 0.0)
    off = jnp.where(of.elastic, of.linear + of.square * at.t - at.z - barrier / at.t, 0.0)
    drive, stiff = (drive + stiff * give * off) / (1 + stiff * give), stiff / (1 + stiff * give)
    horizon = program(slopes, curvatures, at.z + drive, stiff, unmet.defects, damping)
    horizon = horizon._replace(
        end_gradient=horizon.end_gradient + slopes.h.T @ (at.nu + unmet.h / END_COMPLIANCE),
        end_curvature=horizon.end_curvature + slopes.h.T @ slopes.h / END_COMPLIANCE,
    )
    change = least_cost(horizon, free)
    _, of_c, of_h = along(slopes, change.dx, change.du)
    dz = drive + stiff * of_c
    dt = give * (dz - off)
    dy = jnp.where(of.elastic, (barrier - at.y * dt) / at.t - at.y, 0.0)
    prices, nu = change.multipliers - at.prices, (unmet.h + of_h) / END_COMPLIANCE
    return change, Iterate(change.dx, change.du, prices, nu, dt - gap - of_c, dz, dt, dy)


def to_boundary(of: Inequalities, at: Iterate, step: Iterate, share: Array) -> tuple[Array, Array]:
    """Returns the longest step lengths, at most one, that take at most `share` of s and t, and of z and y."""

    def longest(*pairs: tuple[Array, Array, Array]) -> Array:
        fastest = [jnp.max(jnp.where(mask, -d / v, 0.0), initial=0.0) for v, d, mask in pairs]
        return jnp.minimum(1.0, share / jnp.maximum(jnp.max(jnp.stack(fastest)), 1e-30))

    return (
        longest((at.s, step.s, of.present), (at.t, step.t, of.elastic)),
        longest((at.z, step.z, of.present), (at.y, step.y, of.elastic)),
    )


def inside(of: Inequalities, values: Values, x: Array, u: Array, margin: float) -> Iterate:
    """Returns the first iterate: slacks of at least a margin unless strict, z = 1, y >= 1, other multipliers zero."""
    t = jnp.where(of.elastic, jnp.maximum(values.c, 0.0) + margin, 0.0)
    slack = jnp.where(of.strict & (values.c < 0), -values.c, jnp.maximum(t - values.c, margin))
    s, z = jnp.where(of.present, slack, 1.0), jnp.where(of.present, 1.0, 0.0)
    y = jnp.where(of.elastic, jnp.maximum(of.linear + of.square * t - z, 1.0), 0.0)
    return Iterate(x, u, jnp.zeros_like(values.defects), jnp.zeros_like(values.h), s, z, t, y)


def guarded(of: Inequalities, at: Iterate, barrier: Array, spread: float) -> Iterate:
    """Limits z and y so that s z and t y stay within the factor `spread` of the barrier."""

    def within(z: Array, s: Array, mask: Array) -> Array:
        return jnp.where(mask, jnp.clip(z, barrier / (spread * s), spread * barrier / s), 0.0)

    return at._replace(z=within(at.z, at.s, of.present), y=within(at.y, at.t, of.elastic))
