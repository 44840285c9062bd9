"""Dense linear systems and factorisations of one matrix: unrolled for small ones, by LAPACK for others.

The Hessians of learned energies need not be definite, so Cholesky does not apply. The matrices of mechanics have a few
rows and come in batches. Gaussian elimination and substitution, unrolled row by row, fuse with their surroundings: up
to a dozen rows they are faster than library calls.

On a CPU, JAX splits a batched library call over the threads that also run the programs of other devices. Programs that
wait for one another then deadlock (seen with jaxlib 0.10.2: two devices of one process, or several batched calls in one
program on two cores). So under `vmap` on a CPU, matrices are factorised one after the other; on other platforms a batch
is one call. Factors have no derivatives; callers define the derivatives of the solution.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.lax.linalg import cholesky as batched_cholesky
from jax.lax.linalg import eigh, lu, triangular_solve
from jaxtyping import Array, Float

# With more rows the library call is faster, and the unrolled program is slow to compile.
_UNROLLED_ROWS = 16


def one_by_one(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the function with a batching rule that loops over the batch on a CPU."""

    @jax.custom_batching.custom_vmap
    def of_one(*arguments: Array) -> Any:
        return function(*arguments)

    @of_one.def_vmap
    def of_many(_: int, batched: Sequence[bool], *arguments: Array) -> tuple[Any, Any]:
        if not any(batched):
            result = function(*arguments)
            return result, jax.tree.map(lambda _: False, result)

        def merged(call: Callable[..., Any], members: Sequence[Array]) -> Any:
            rest = iter(members)
            return call(
                *(next(rest) if split else argument for argument, split in zip(arguments, batched, strict=True))
            )

        def in_turn(*members: Array) -> Any:
            return lax.map(lambda member: merged(of_one, member), members)

        def at_once(*members: Array) -> Any:
            return jax.vmap(lambda *members: merged(function, members))(*members)

        split = [argument for argument, split in zip(arguments, batched, strict=True) if split]
        results = lax.platform_dependent(*split, cpu=in_turn, default=at_once)
        return results, jax.tree.map(lambda _: True, results)

    return of_one


@one_by_one
def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Returns L with A = L Lᵀ from the lower triangle of A; NaN if A is not positive definite."""
    return batched_cholesky(matrix, symmetrize_input=False)


@one_by_one
def symmetric_eigen(matrix: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Returns the eigenvalues, ascending, and eigenvectors (columns) of a symmetric matrix, from its lower triangle."""
    vectors, values = eigh(matrix, lower=True, symmetrize_input=False)
    return values, vectors


def solve(matrix: Float[Array, "n n"], b: Float[Array, "n *columns"]) -> Float[Array, "n *columns"]:
    """Returns x with A x = b, for b [n] or [n, k]; not finite for an exactly singular matrix.

    Derivatives of every order follow from A dx = db - dA x, not from the steps of the elimination.
    """
    if b.shape[0] == 1:
        return b / matrix[0]
    few = b.shape[0] <= _UNROLLED_ROWS
    factors = () if few else _lu_factors(lax.stop_gradient(matrix))

    def columns(one: Callable[..., Array], right: Array) -> Array:
        return one(*factors, right.reshape(right.shape[0], -1)).reshape(right.shape)

    return lax.custom_linear_solve(
        functools.partial(jnp.matmul, matrix),
        b,
        lambda _, right: _eliminate(matrix, right) if few else columns(_solve_lu, right),
        transpose_solve=lambda _, right: _eliminate(matrix.T, right) if few else columns(_solve_lu_transposed, right),
    )


@one_by_one
def _lu_factors(matrix: Array) -> tuple[Array, Array]:
    factors, _, permutation = lu(matrix)
    return factors, permutation


@one_by_one
def _solve_lu(factors: Array, permutation: Array, b: Array) -> Array:
    y = triangular_solve(factors, b[permutation], left_side=True, lower=True, unit_diagonal=True)
    return triangular_solve(factors, y, left_side=True, lower=False)


@one_by_one
def _solve_lu_transposed(factors: Array, permutation: Array, b: Array) -> Array:
    y = triangular_solve(factors, b, left_side=True, lower=False, transpose_a=True)
    x = triangular_solve(factors, y, left_side=True, lower=True, unit_diagonal=True, transpose_a=True)
    return x[jnp.argsort(permutation)]


def substitute(
    factor: Float[Array, "n n"], b: Float[Array, "rows columns"], *, transposed: bool = False, right: bool = False
) -> Float[Array, "rows columns"]:
    """Returns x with L x = b, or Lᵀ x = b if `transposed`, for the lower triangle L of a matrix.

    `right` puts the triangle on the right of x: x L = b, or x Lᵀ = b.
    """
    return _substitution(transposed, right)(factor, b)


@functools.cache
def _substitution(transposed: bool, right: bool) -> Callable[[Array, Array], Array]:
    one = one_by_one(functools.partial(triangular_solve, left_side=not right, lower=True, transpose_a=transposed))
    return shared_or_batched(one, jax.vmap(one), side=0 if right else 1)


def shared_or_batched(
    one: Callable[[Array, Array], Array], many: Callable[[Array, Array], Array], *, side: int = 1
) -> Callable[[Array, Array], Array]:
    """Returns the solve (matrix, b) -> x, by `many` for a batch of matrices; a batch of b alone becomes columns."""

    @jax.custom_batching.custom_vmap
    def solve(matrix: Array, b: Array) -> Array:
        return one(matrix, b)

    @solve.def_vmap
    def solve_many(size: int, batched: Sequence[bool], matrix: Array, b: Array) -> tuple[Array, bool]:
        if not any(batched):
            return one(matrix, b), False
        if batched[0]:
            return many(matrix, b if batched[1] else jnp.broadcast_to(b, (size, *b.shape))), True
        columns = jnp.moveaxis(b, 0, side)
        every = solve(matrix, lax.collapse(columns, side, side + 2))
        return jnp.moveaxis(every.reshape(columns.shape), side, 0), True

    return solve


def _eliminate(matrix: Float[Array, "n n"], b: Float[Array, "n *columns"]) -> Float[Array, "n *columns"]:
    n = b.shape[0]
    rows = jnp.concatenate([matrix, b.reshape(n, -1)], axis=1)
    pivots = []
    for _ in range(n):
        # Selection by comparison compiles faster than indexing by a computed row.
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
        fixed = lax.stop_gradient(lower)
        return lax.custom_linear_solve(
            functools.partial(jnp.matmul, lower),
            b,
            lambda _, right: substitute(fixed, right[:, None])[:, 0],
            transpose_solve=lambda _, right: substitute(fixed, right[:, None], transposed=True)[:, 0],
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
