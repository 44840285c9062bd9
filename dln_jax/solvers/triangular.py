"""Substitution with small triangular matrices, written out element by element.

The matrices of mechanics have a few rows and come in batches. Written out, they fuse with what surrounds them, which
is faster than one library call per matrix up to a dozen rows; and several batched LAPACK calls in one program can
wait for each other for ever on a machine with few cores (seen with jaxlib 0.10.2 on two).
"""

import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

# Beyond this size the library call is faster, and the written-out program slow to compile.
_WRITTEN_OUT_ROWS = 16


def solve_lower(factor: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """x [n] with L x = b, by forward substitution. A zero on the diagonal gives non-finite values."""
    if b.shape[0] > _WRITTEN_OUT_ROWS:
        return solve_triangular(factor, b, lower=True)
    x = []
    for i in range(b.shape[0]):
        remainder = b[i]
        for j, solved in enumerate(x):
            remainder -= factor[i, j] * solved
        x.append(remainder / factor[i, i])
    return jnp.stack(x)


def solve_lower_transposed(factor: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """x [n] with Lᵀ x = b, by back substitution. A zero on the diagonal gives non-finite values."""
    # Reversing both axes turns the upper triangle of Lᵀ into a lower one.
    return solve_lower(factor.T[::-1, ::-1], b[::-1])[::-1]
