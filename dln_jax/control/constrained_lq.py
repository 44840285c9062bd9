"""Convex quadratic programs over a horizon with limited controls, by an interior-point method.

    min  sum_k gᵀ (dx_k, du_k) + ½ (dx_k, du_k)ᵀ H (dx_k, du_k) + end,   dx_0 = 0
         dx_{k+1} = F (dx_k, du_k) + d_k,   low <= du_k <= high

A primal-dual method whose linear systems are Riccati recursions (Rao, Wright and Rawlings 1998). A limit adds z / s to
the controls' Hessian, with s the distance from the limit and z its multiplier; s z tends to zero.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from dln_jax.solvers.elimination import solve
from dln_jax.solvers.lapack import cholesky

CENTRING = 0.1
"""Target of a step for s z, relative to its present value."""
SHORT_OF_LIMITS = 0.995
"""Length of a step, relative to the longest one within the limits."""
SMALL = 1e-11
"""The method ends when s z is below this share of its first value."""
MOST_STEPS = 60


class Horizon(NamedTuple):
    """A program of N steps of n states and m controls."""

    slopes: Float[Array, "N n n+m"]
    missed: Float[Array, "N n"]
    gradients: Float[Array, "N n+m"]
    curvatures: Float[Array, "N n+m n+m"]
    end_gradient: Float[Array, " n"]
    end_curvature: Float[Array, "n n"]
    low: Float[Array, "N m"]
    """Infinite without a limit; negative or zero, and `high` positive or zero."""
    high: Float[Array, "N m"]


class HorizonSolution(NamedTuple):
    """Minimiser; not finite if there is no minimum."""

    dx: Float[Array, "N+1 n"]
    du: Float[Array, "N m"]
    K: Float[Array, "N m n"]
    """Feedback of the controls from the state, zero where a limit is active."""
    multipliers: Float[Array, "N n"]
    """Derivative of the cost to go by dx_{k+1}."""


class _Point(NamedTuple):
    solution: HorizonSolution
    below: Array
    above: Array
    product: Array
    steps: Array


def least_cost(horizon: Horizon) -> HorizonSolution:
    """Returns the solution; traceable."""
    low, high = horizon.low, horizon.high
    finite = jnp.isfinite(low), jnp.isfinite(high)
    limits = jnp.maximum(jnp.sum(finite[0]) + jnp.sum(finite[1]), 1)
    width = jnp.where(finite[0] & finite[1], high - low, 1.0)
    du = jnp.clip(jnp.zeros_like(low), low + 0.1 * width, high - 0.1 * width)
    size = jnp.max(jnp.abs(horizon.gradients)) + jnp.max(jnp.abs(horizon.end_gradient))
    below, above = (jnp.where(limited, size / width, 0.0) for limited in finite)

    def complementarity(du: Array, below: Array, above: Array) -> Array:
        products = jnp.where(finite[0], below * (du - low), 0.0) + jnp.where(finite[1], above * (high - du), 0.0)
        return jnp.sum(products) / limits

    def step(point: _Point) -> _Point:
        dx, du, below, above = *point.solution[:2], point.below, point.above
        under, over, aim = du - low, high - du, CENTRING * point.product
        # About the present point, because the weights of controls at their limits exceed all else by ten orders.
        solution = _recursion(_about(horizon, dx, du), aim / over - aim / under, below / under + above / over)
        change = solution.du
        of_below, of_above = (aim - below * change) / under - below, (aim + above * change) / over - above
        fastest = [-change / under, change / over]
        fastest += [jnp.where(z > 0, -dz / z, 0.0) for z, dz in ((below, of_below), (above, of_above))]
        length = jnp.minimum(1.0, SHORT_OF_LIMITS / jnp.maximum(jnp.max(jnp.stack(fastest)), 1e-30))
        du, below, above = du + length * change, below + length * of_below, above + length * of_above
        solution = solution._replace(dx=dx + length * solution.dx, du=du)
        return _Point(solution, below, above, complementarity(du, below, above), point.steps + 1)

    first = complementarity(du, below, above)

    def going(point: _Point) -> Array:
        return (point.product > SMALL * first) & (point.steps < MOST_STEPS)

    K = jnp.zeros((*du.shape, horizon.missed.shape[1]), du.dtype)
    start = HorizonSolution(_forward(horizon, du, K)[0], du, K, jnp.zeros_like(horizon.missed))
    return jax.lax.while_loop(going, step, step(_Point(start, below, above, first, jnp.asarray(0)))).solution


def _about(horizon: Horizon, dx: Array, du: Array) -> Horizon:
    """Returns the program of changes about a point."""
    both = jnp.concatenate([dx[:-1], du], axis=1)
    return horizon._replace(
        missed=jnp.zeros_like(horizon.missed),
        gradients=horizon.gradients + jnp.einsum("kij,kj->ki", horizon.curvatures, both),
        end_gradient=horizon.end_gradient + horizon.end_curvature @ dx[-1],
    )


def _recursion(horizon: Horizon, gradient: Array, weight: Array) -> HorizonSolution:
    """Returns the minimum without limits of the program plus ½ weight du² + gradient du."""
    n = horizon.missed.shape[1]

    def back(value: tuple[Array, Array], stage: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
        g, S = value
        F, missed, of_cost, curvature, beside, weight = stage
        q, Q = of_cost + F.T @ (g + S @ missed), curvature + F.T @ S @ F
        qu, Quu, Qux = q[n:] + beside, Q[n:, n:] + jnp.diag(weight), Q[n:, :n]
        both = -solve(Quu, jnp.concatenate([qu[:, None], Qux], axis=1))
        k, K = both[:, 0], both[:, 1:]
        before = Q[:n, :n] + Qux.T @ K
        # NaN unless the problem is convex.
        convex = jnp.isfinite(cholesky(Quu)).all()
        return (q[:n] + Qux.T @ k, jnp.where(convex, (before + before.T) / 2, jnp.nan)), (k, K, g, S)

    stages = horizon.slopes, horizon.missed, horizon.gradients, horizon.curvatures, gradient, weight
    end = horizon.end_gradient, horizon.end_curvature
    _, (k, K, g, S) = jax.lax.scan(back, end, stages, reverse=True)
    dx, du = _forward(horizon, k, K)
    return HorizonSolution(dx, du, K, g + jnp.einsum("kij,kj->ki", S, dx[1:]))


def _forward(horizon: Horizon, k: Array, K: Array) -> tuple[Array, Array]:
    """States and controls du = k + K dx from the start on."""

    def forth(dx: Array, stage: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
        F, missed, k, K = stage
        du = k + K @ dx
        after = F @ jnp.concatenate([dx, du]) + missed
        return after, (after, du)

    start = jnp.zeros_like(horizon.end_gradient)
    _, (dx, du) = jax.lax.scan(forth, start, (horizon.slopes, horizon.missed, k, K))
    return jnp.concatenate([start[None], dx]), du
