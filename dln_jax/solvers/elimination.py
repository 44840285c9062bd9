"""Small linear systems, unrolled row by row: Gaussian elimination, and substitution with triangular matrices.

The Hessians of learned energies need not be definite, so Cholesky does not apply. The matrices of mechanics have a few
rows and come in batches. Unrolled, they fuse with their surroundings: up to a dozen rows faster than library calls.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.solvers import lapack

# With more rows the library call is faster, and the unrolled program is slow to compile.
_UNROLLED_ROWS = 16


def solve(matrix: Float[Array, "n n"], b: Float[Array, "n *columns"]) -> Float[Array, "n *columns"]:
    """Returns x with A x = b, for b [n] or [n, k]; not finite for an exactly singular matrix.

    Derivatives of every order are those of the solution (A dx = db - dA x), not of the elimination's steps.
    """
    if b.shape[0] == 1:
        return b / matrix[0]
    if b.shape[0] > _UNROLLED_ROWS:
        return lapack.solve(matrix, b)
    return jax.lax.custom_linear_solve(
        functools.partial(jnp.matmul, matrix),
        b,
        lambda _, right: _eliminate(matrix, right),
        transpose_solve=lambda _, right: _eliminate(matrix.T, right),
    )


def _eliminate(matrix: Float[Array, "n n"], b: Float[Array, "n *columns"]) -> Float[Array, "n *columns"]:
    n = b.shape[0]
    rows = jnp.concatenate([matrix, b.reshape(n, -1)], axis=1)
    pivots = []
    for _ in range(n):
        # Selected by comparison: indexing by a computed row compiles more slowly.
        chosen = (jnp.arange(len(rows)) == jnp.argmax(jnp.abs(rows[:, 0])))[:, None]
        pivot = jnp.sum(jnp.where(chosen, rows, 0), axis=0)
        rows = jnp.where(chosen, rows[0], rows)[1:]
        rows = rows[:, 1:] - (rows[:, :1] / pivot[0]) * pivot[1:]
        pivots.append(pivot)
    # The k-th pivot row from the end reads (u_kk, the k elements right of it, its right-hand sides).
    solution = []
    for pivot in reversed(pivots):
        remainder = pivot[1 + len(solution) :]
        for coefficient, solved in zip(pivot[1:], solution, strict=False):
            remainder -= coefficient * solved
        solution.insert(0, remainder / pivot[0])
    return jnp.stack(solution).reshape(b.shape)


def solve_lower(factor: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """Returns x [n] with L x = b by forward substitution; not finite for a zero on the diagonal."""
    if b.shape[0] > _UNROLLED_ROWS:
        lower = jnp.tril(factor)
        fixed = jax.lax.stop_gradient(lower)
        return jax.lax.custom_linear_solve(
            functools.partial(jnp.matmul, lower),
            b,
            lambda _, right: lapack.substitute(fixed, right[:, None])[:, 0],
            transpose_solve=lambda _, right: lapack.substitute(fixed, right[:, None], transposed=True)[:, 0],
        )
    x = []
    for i in range(b.shape[0]):
        remainder = b[i]
        for j, solved in enumerate(x):
            remainder -= factor[i, j] * solved
        x.append(remainder / factor[i, i])
    return jnp.stack(x)


def solve_lower_transposed(factor: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """Returns x [n] with Lᵀ x = b by back substitution; not finite for a zero on the diagonal."""
    # Reversing both axes turns the upper triangle of Lᵀ into a lower one.
    return solve_lower(factor.T[::-1, ::-1], b[::-1])[::-1]
