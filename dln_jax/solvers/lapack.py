"""LAPACK's factorisations of one matrix, which under `vmap` take the matrices of a batch one after the other.

On a processor, JAX hands a batch to a library call that splits it over the threads that also run the programs of other
devices. Where those wait for each other, all wait for ever (seen with jaxlib 0.10.2: two devices of one process, or
several batched calls in one program on two cores); and a loop over the matrices is as fast. Elsewhere, a batch is one
call. None of the functions has derivatives: callers know those of the solution.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.lax.linalg import cholesky as batched_cholesky
from jax.lax.linalg import triangular_solve
from jaxtyping import Array, Float


def one_by_one(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function of arrays; under `vmap`, a processor loops over the batch."""

    @jax.custom_batching.custom_vmap
    def of_one(*arguments: Array) -> Any:
        return function(*arguments)

    @of_one.def_vmap
    def of_many(_: int, batched: Sequence[bool], *arguments: Array) -> tuple[Any, Any]:
        def merged(call: Callable[..., Any], members: Sequence[Array]) -> Any:
            rest = iter(members)
            return call(*(next(rest) if split else each for each, split in zip(arguments, batched, strict=True)))

        def in_turn(*members: Array) -> Any:
            return lax.map(lambda each: merged(of_one, each), members)

        def at_once(*members: Array) -> Any:
            return jax.vmap(lambda *each: merged(function, each))(*members)

        split = [each for each, split in zip(arguments, batched, strict=True) if split]
        results = lax.platform_dependent(*split, cpu=in_turn, default=at_once)
        return results, jax.tree.map(lambda _: True, results)

    return of_one


@one_by_one
def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """L of A = L Lᵀ from the lower triangle of A; NaN where A is not positive definite."""
    return batched_cholesky(matrix, symmetrize_input=False)


def substitute(
    factor: Float[Array, "n n"], b: Float[Array, "n k"], *, transposed: bool = False, right: bool = False
) -> Float[Array, "n k"]:
    """x with L x = b, or Lᵀ x = b if `transposed`, for the lower triangle L of a matrix.

    `right` puts the triangle on the right of x: x L = b, or x Lᵀ = b, with b [k, n].
    """
    return _substitution(transposed, right)(factor, b)


@functools.cache
def _substitution(transposed: bool, right: bool) -> Callable[[Array, Array], Array]:
    with_one = one_by_one(functools.partial(triangular_solve, left_side=not right, lower=True, transpose_a=transposed))

    @jax.custom_batching.custom_vmap
    def solve(factor: Array, b: Array) -> Array:
        return with_one(factor, b)

    @solve.def_vmap
    def solve_many(size: int, batched: Sequence[bool], factor: Array, b: Array) -> tuple[Array, bool]:
        if batched[0]:
            return jax.vmap(with_one, in_axes=tuple(0 if each else None for each in batched))(factor, b), True
        # One factor for all: their right-hand sides are columns of one.
        side = 0 if right else 1
        columns = jnp.moveaxis(b, 0, side)
        every = solve(factor, lax.collapse(columns, side, side + 2))
        return jnp.moveaxis(every.reshape(columns.shape), side, 0), True

    return solve
