"""Preconditioned conjugate gradients that say when a matrix is not positive definite."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Vector = Float[Array, "..."]


def conjugate_gradients(
    product: Callable[[Vector], Vector],
    b: Vector,
    precondition: Callable[[Vector], Vector],
    *,
    tolerance: float,
    iterations: int,
) -> Vector:
    """x with A x = b to a relative residual, |b - A x| <= tolerance |b|, from x = 0.

    A direction of curvature <= 0 shows that A is not positive definite; then, and if the iterations do not suffice, the
    result is not finite.

    Args:
        product: x -> A x, A symmetric.
        b: right-hand side, of any shape.
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
    # A right-hand side that is not finite ends the loop at once, because it compares as false.
    last = jax.lax.while_loop(more, iterate, (jnp.zeros_like(b), b, z, jnp.vdot(b, z), 0, jnp.asarray(True)))
    x, r, _, _, _, definite = last
    solved = definite & (jnp.linalg.norm(r.reshape(-1)) <= enough)
    return jnp.where(solved, x, jnp.nan)
