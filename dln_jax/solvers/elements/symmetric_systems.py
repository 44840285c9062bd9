"""Large symmetric systems: block-tridiagonal Cholesky as a scan over the blocks, and conjugate gradients.

H = [[D_0, C_1ᵀ, ...], [C_1, D_1, C_2ᵀ, ...], ...],    H = L Lᵀ with diagonal blocks L_i and blocks W_i below them:
L_i L_iᵀ = D_i - W_i W_iᵀ,    W_i L_{i-1}ᵀ = C_i
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.solvers.lapack import cholesky, substitute

Vector = Float[Array, "..."]
Factor = tuple[Float[Array, "count s s"], Float[Array, "count s s"]]
"""(L_i, W_i); W_0 is zero."""


def factorise_blocks(diagonal: Float[Array, "count s s"], below: Float[Array, "count1 s s"]) -> Factor:
    """Returns L of a block-tridiagonal matrix; not finite if the matrix is not positive definite.

    Args:
        diagonal: D_i; only their lower triangles are read.
        below: C_1, C_2, ...: block i of the rows against block i - 1 of the columns.
    """

    def eliminate(previous: Array, blocks: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        d, c = blocks
        w = substitute(previous, c, transposed=True, right=True)
        factor = cholesky(d - w @ w.T)
        return factor, (factor, w)

    first = cholesky(diagonal[0])
    _, (factors, w) = jax.lax.scan(eliminate, first, (diagonal[1:], below))
    return jnp.concatenate([first[None], factors]), jnp.concatenate([jnp.zeros_like(first)[None], w])


def solve_blocks(factor: Factor, b: Float[Array, "count s"]) -> Float[Array, "count s"]:
    """Returns x with L Lᵀ x = b."""

    def forwards(y: Array, blocks: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        lower, w, right = blocks
        y = substitute(lower, (right - w @ y)[:, None])[:, 0]
        return y, y

    def backwards(carry: Array, blocks: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        lower, w, y = blocks
        x = substitute(lower, (y - carry)[:, None], transposed=True)[:, 0]
        return w.T @ x, x

    zero = jnp.zeros_like(b[0])
    _, y = jax.lax.scan(forwards, zero, (*factor, b))
    _, x = jax.lax.scan(backwards, zero, (*factor, y), reverse=True)
    return x


def conjugate_gradients(
    product: Callable[[Vector], Vector],
    b: Vector,
    precondition: Callable[[Vector], Vector],
    *,
    tolerance: float,
    iterations: int,
) -> Vector:
    """Returns x with A x = b to a relative residual, |b - A x| <= tolerance |b|, starting from x = 0.

    A direction of curvature <= 0 shows that A is not positive definite. The result is not finite then, or if the
    iterations do not suffice.

    Args:
        product: x -> A x, A symmetric.
        precondition: r -> an approximation of A⁻¹ r, symmetric positive definite.
        tolerance: relative residual.
        iterations: products after which the search gives up.
    """
    enough = tolerance * jnp.linalg.norm(b.reshape(-1))

    def more(state):
        _, r, _, _, count, definite = state
        return (jnp.linalg.norm(r.reshape(-1)) > enough) & (count < iterations) & definite

    def iterate(state):
        x, r, p, rz, count, _ = state
        product_p = product(p)
        curvature = jnp.vdot(p, product_p)
        length = rz / curvature
        x, r = x + length * p, r - length * product_p
        z = precondition(r)
        next_rz = jnp.vdot(r, z)
        return x, r, z + (next_rz / rz) * p, next_rz, count + 1, curvature > 0

    z = precondition(b)
    # A right-hand side that is not finite ends the loop at once, because comparisons with NaN are false.
    last = jax.lax.while_loop(more, iterate, (jnp.zeros_like(b), b, z, jnp.vdot(b, z), 0, jnp.asarray(True)))
    x, r, _, _, _, definite = last
    solved = definite & (jnp.linalg.norm(r.reshape(-1)) <= enough)
    return jnp.where(solved, x, jnp.nan)
