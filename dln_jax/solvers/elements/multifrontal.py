"""Multifrontal Cholesky factorisation of a sparse matrix, H = L Lᵀ, following a plan of its fronts (Duff, Reid 1983).

A front sums entries of H and the matrices U that its children in the elimination tree left; then it is eliminated:

    F = [[F11, F21ᵀ], [F21, F22]],    L11 L11ᵀ = F11,    L21 L11ᵀ = F21,    U = F22 - L21 L21ᵀ

by square tiles, left-looking within the front. The plan has the loops' lengths: one compiled body serves all fronts.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from dln_jax.solvers.elements.fronts import Plan
from dln_jax.solvers.lapack import cholesky, substitute

Tiles = Float[Array, "tiles size size"]


def factorise(at: Plan, entries: Float[Array, " entries"]) -> Tiles:
    """Returns L; not finite if the matrix is not positive definite."""
    at = _on_device(at)
    count, size = at.size**2, jnp.int32(at.size)
    tiles = jnp.zeros(at.tiles * count, entries.dtype)
    tiles = tiles.at[at.entries].set(entries, unique_indices=True, mode="promise_in_bounds")
    tiles = tiles.at[at.units].set(1, unique_indices=True, mode="promise_in_bounds").reshape(-1, at.size, at.size)

    def compute(number: Array, tiles: Tiles) -> Tiles:
        target = _row(at.targets, number)

        def add(number: Array, sum_: Array) -> Array:
            part = _row(at.parts, number)
            row, column = (_slice(at.child_rows, first, at.size) for first in (part.rows, part.columns))
            # Parent and child have rows and columns in the same order, so one lower triangle gives the other.
            known = (column >= 0) & (row[:, None] >= column)
            i, j = row - part.first_row, column - part.first_column
            of_row = lax.div(i, size) * (2 * count) + lax.rem(i, size) * size
            place = jnp.where(known, of_row[:, None] + lax.div(j, size) * count + lax.rem(j, size), -1)
            # The barrier keeps XLA from recomputing the places, slowly, in the loop that reads the numbers.
            place = lax.optimization_barrier(place)
            near = jnp.concatenate([_slice(tiles, first, 2) for first in (part.upper, part.lower)])
            return sum_ + jnp.where(place >= 0, _take(near.reshape(-1), jnp.maximum(place, 0)), 0)

        def subtract(k: Array, sum_: Array) -> Array:
            return sum_ - _tile(tiles, target.left + k) @ _tile(tiles, target.right + k).T

        sum_ = jnp.where(target.kept, _tile(tiles, target.tile), 0)
        sum_ = lax.fori_loop(target.first_part, target.last_part, add, sum_)
        return _with_tile(tiles, target.tile, lax.fori_loop(0, target.products, subtract, sum_))

    def eliminate(number: Array, tiles: Tiles) -> Tiles:
        step = _row(at.steps, number)
        tiles = lax.fori_loop(step.first_target, step.last_target, compute, tiles)

        def column(_: Array, tiles: Tiles) -> Tiles:
            lower = cholesky(_tile(tiles, step.diagonal))

            def below(number: Array, tiles: Tiles) -> Tiles:
                tile = at.below[number]
                return _with_tile(tiles, tile, substitute(lower, _tile(tiles, tile), transposed=True, right=True))

            return lax.fori_loop(step.first_below, step.last_below, below, _with_tile(tiles, step.diagonal, lower))

        # A loop of length 0 or 1: a branch would copy all tiles.
        return lax.fori_loop(0, step.columns, column, tiles)

    return lax.fori_loop(0, len(at.steps.columns), eliminate, tiles)


def solve(at: Plan, factor: Tiles, b: Float[Array, " n"]) -> Float[Array, " n"]:
    """Returns x with L Lᵀ x = b; zero for unknowns that are not eliminated."""
    at = _on_device(at)
    x = jnp.zeros(at.length + 1, b.dtype).at[at.places].set(b).at[-1].set(0)

    def own(x: Array, place: Array) -> Array:
        return _slice(x, place, at.size)

    def forwards(number: Array, x: Array) -> Array:
        step = _row(at.steps, number)

        def column(_: Array, x: Array) -> Array:
            y = substitute(_tile(factor, step.diagonal), own(x, step.place)[:, None])[:, 0]

            def below(number: Array, x: Array) -> Array:
                return x.at[at.rows[number]].add(-_tile(factor, at.below[number]) @ y, mode="promise_in_bounds")

            x = lax.dynamic_update_slice(x, y, (step.place,))
            return lax.fori_loop(step.first_below, step.last_below, below, x)

        return lax.fori_loop(0, step.columns, column, x)

    def backwards(number: Array, x: Array) -> Array:
        step = _row(at.steps, len(at.steps.columns) - 1 - number)

        def column(_: Array, x: Array) -> Array:
            def below(number: Array, right: Array) -> Array:
                return right - _take(x, at.rows[number]) @ _tile(factor, at.below[number])

            right = lax.fori_loop(step.first_below, step.last_below, below, own(x, step.place))
            solution = substitute(_tile(factor, step.diagonal), right[:, None], transposed=True)[:, 0]
            return lax.dynamic_update_slice(x, solution, (step.place,))

        return lax.fori_loop(0, step.columns, column, x)

    x = lax.fori_loop(0, len(at.steps.columns), backwards, lax.fori_loop(0, len(at.steps.columns), forwards, x))
    return _take(x, at.places)


def _on_device(at: Plan) -> Plan:
    return jax.tree.map(lambda table: table if isinstance(table, int) else jnp.asarray(table), at)


def _row(table: Any, number: Array) -> Any:
    return type(table)(*(column[number] for column in table))


def _slice(array: Any, first: Array, count: int) -> Array:
    return lax.dynamic_slice_in_dim(array, first, count)


def _tile(tiles: Tiles, number: Array) -> Float[Array, "size size"]:
    return lax.dynamic_index_in_dim(tiles, number, keepdims=False)


def _with_tile(tiles: Tiles, number: Array, tile: Float[Array, "size size"]) -> Tiles:
    return lax.dynamic_update_index_in_dim(tiles, tile, number, 0)


def _take(values: Array, places: Any) -> Array:
    return values.at[places].get(mode="promise_in_bounds", wrap_negative_indices=False)
