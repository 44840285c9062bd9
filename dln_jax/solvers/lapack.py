"""LAPACK factorisations of one matrix, which under `vmap` on a CPU run one matrix after the other.

On a CPU, JAX passes a batch to a library call that splits it over the threads that also run the programs of other
devices. If these programs wait for one another, all deadlock (seen with jaxlib 0.10.2: two devices of one process, or
several batched calls in one program on two cores). On other platforms a batch is one call. Factors have no derivatives;
callers supply those of the solution.
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


def one_by_one(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a function of arrays whose batching rule loops over the batch on a CPU."""

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
    """Returns x with A x = b by LU factors of A; derivatives of every order are those of the solution."""
    factors = _lu_factors(lax.stop_gradient(matrix))

    def columns(one: Callable[..., Array], right: Array) -> Array:
        return one(*factors, right.reshape(right.shape[0], -1)).reshape(right.shape)

    return lax.custom_linear_solve(
        functools.partial(jnp.matmul, matrix),
        b,
        lambda _, right: columns(_solve_lu, right),
        transpose_solve=lambda _, right: columns(_solve_lu_transposed, right),
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
