"""Quadratic programs over a horizon without inequalities, by Riccati's recursion.

    min  sum_k gᵀ (dx_k, du_k) + ½ (dx_k, du_k)ᵀ H (dx_k, du_k) + end,   dx_{k+1} = F (dx_k, du_k) + d_k

The components of dx_0 are zero, or free where stated. The recursion factorises the matrix of the Karush-Kuhn-Tucker
conditions stage by stage (Rao, Wright and Rawlings 1998). All its pivots are positive if and only if the program has a
unique minimum: the inertia test of interior-point methods.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from dln_jax.solvers.elimination import cholesky, substitute


class Horizon(NamedTuple):
    """A program of N steps with n states and m controls."""

    slopes: Float[Array, "N n n+m"]
    missed: Float[Array, "N n"]
    gradients: Float[Array, "N n+m"]
    curvatures: Float[Array, "N n+m n+m"]
    end_gradient: Float[Array, " n"]
    end_curvature: Float[Array, "n n"]


class HorizonSolution(NamedTuple):
    """Minimiser; meaningless unless `convex`."""

    dx: Float[Array, "N+1 n"]
    du: Float[Array, "N m"]
    K: Float[Array, "N m n"]
    """Feedback gains from the state to the controls."""
    multipliers: Float[Array, "N n"]
    """Derivative of the cost to go by dx_{k+1}."""
    convex: Bool[Array, ""]
    """True if the program has a unique minimum."""


def least_cost(horizon: Horizon, free: Any = None) -> HorizonSolution:
    """Returns the solution; traceable. `free` [n] marks the unknown components of the first state."""
    n = horizon.missed.shape[1]

    def back(
        value: tuple[Array, Array, Array], stage: tuple[Array, ...]
    ) -> tuple[tuple[Array, Array, Array], tuple[Array, ...]]:
        g, S, convex = value
        F, missed, gradient, curvature = stage
        q, Q = gradient + F.T @ (g + S @ missed), curvature + F.T @ S @ F
        k, K, before, definite = eliminated(n, q, Q)
        return (*before, convex & definite), (k, K, g, S)

    end = horizon.end_gradient, horizon.end_curvature, jnp.asarray(True)
    (g0, S0, convex), (k, K, g, S) = jax.lax.scan(back, end, horizon[:4], reverse=True)
    start = jnp.zeros_like(g0)
    if free is not None:
        free = jnp.asarray(free)
        block = jnp.where(free[:, None] & free, S0, jnp.eye(n, dtype=S0.dtype))
        solved, definite = _definite_solve(block, jnp.where(free, -g0, 0.0)[:, None])
        start, convex = solved[:, 0], convex & definite

    def forth(dx: Array, stage: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
        F, missed, k, K = stage
        du = k + K @ dx
        after = F @ jnp.concatenate([dx, du]) + missed
        return after, (after, du)

    _, (dx, du) = jax.lax.scan(forth, start, (horizon.slopes, horizon.missed, k, K))
    multipliers = g + jnp.einsum("kij,kj->ki", S, dx)
    return HorizonSolution(jnp.concatenate([start[None], dx]), du, K, multipliers, convex)


def eliminated(n: int, q: Array, Q: Array) -> tuple[Array, Array, tuple[Array, Array], Array]:
    """Eliminates the controls from q·(dx, du) + ½ (dx, du)ᵀ Q (dx, du), with n states.

    Returns k and K of du = k + K dx, gradient and curvature by dx, and whether the minimum is unique.
    """
    both, definite = _definite_solve(Q[n:, n:], jnp.concatenate([q[n:, None], Q[n:, :n]], axis=1))
    k, K = -both[:, 0], -both[:, 1:]
    rest = Q[:n, :n] + Q[:n, n:] @ K
    return k, K, (q[:n] + Q[:n, n:] @ k, (rest + rest.T) / 2), definite


def made_convex(R: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Returns R, plus a multiple of the identity (from Gershgorin's discs) if R is not positive definite; |R| if m =
    1."""
    if len(R) == 1:
        return jnp.abs(R)
    diagonal = jnp.diagonal(R)
    lowest = jnp.min(diagonal + jnp.abs(diagonal) - jnp.sum(jnp.abs(R), axis=1))
    shift = jnp.where(jnp.isfinite(cholesky(R)).all(), 0.0, 2 * jnp.maximum(-lowest, 0.0))
    return R + shift * jnp.eye(len(R), dtype=R.dtype)


def _definite_solve(matrix: Array, b: Array) -> tuple[Array, Array]:
    """Returns x with A x = b, and whether A is positive definite."""
    if len(matrix) == 1:
        return b / matrix, matrix[0, 0] > 0
    factor = cholesky(matrix)
    return substitute(factor, substitute(factor, b), transposed=True), jnp.isfinite(factor).all()
