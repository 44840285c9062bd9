"""Linear maps whose transposes are given, for forward and reverse mode and under `vmap`.

Differentiation transposes a gather into a scatter, which costs a loop iteration per element on a CPU, although the
transposed map may be a gather as well. y = G x is here the second half of the solution of

    [[1, 0], [-G, 1]] (u, w) = (x, 0),    with the transposed solution u = x + Gᵀ w,

because a linear solve is what JAX lets one give a transpose of, and map over.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Vector = Float[Array, " n"]


def linear_map(
    apply: Callable[[Vector], Vector], transposed: Callable[[Vector], Vector], x: Vector, size: int
) -> Float[Array, " size"]:
    """apply(x), which is differentiated by `transposed` in reverse mode.

    Args:
        apply: x [n] -> y [size], linear.
        transposed: y [size] -> x [n], its transpose.
        x: to which it is applied.
        size: of y.
    """
    n = len(x)

    def product(both: Vector) -> Vector:
        return jnp.concatenate([both[:n], both[n:] - apply(both[:n])])

    def solve(_: Callable[[Vector], Vector], both: Vector) -> Vector:
        return jnp.concatenate([both[:n], both[n:] + apply(both[:n])])

    def solve_transposed(_: Callable[[Vector], Vector], both: Vector) -> Vector:
        return jnp.concatenate([both[:n] + transposed(both[n:]), both[n:]])

    both = jnp.concatenate([x, jnp.zeros(size, x.dtype)])
    return jax.lax.custom_linear_solve(product, both, solve, transpose_solve=solve_transposed)[n:]
