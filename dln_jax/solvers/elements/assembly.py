"""Assembles the gradient and the Hessian of a sum of element energies.

The elements' connectivity is known before tracing. Assembly gathers and adds along index arrays made once here, because
a scatter costs a loop iteration per element.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dln_jax.solvers.elements.energies import Blocks, ElementEnergy, values_and_slopes
from dln_jax.types import InputError


class Pattern(NamedTuple):
    """Static index arrays that assemble the gradient and the lower triangle of the Hessian.

    Unknown number `r` is x.ravel()[r]. Sources index the elements' components (the first component of all elements,
    then the second, ...); an index past the end stands for zero.
    """

    blocks: int
    """n."""
    width: int
    """b."""
    free: Bool[np.ndarray, "n b"]
    """True for the unknowns to solve for."""
    rows: Int[np.ndarray, " entries"]
    columns: Int[np.ndarray, " entries"]
    """Row and column of every entry of the Hessian; columns <= rows."""
    sources: tuple[Int[np.ndarray, "some terms"], ...]
    """Element entries that sum to entry 0, 1, ... of the Hessian, in tables grouped by the number of terms."""
    diagonal: Int[np.ndarray, " unknowns"]
    """Index of every unknown's diagonal entry; past the end if the unknown is not free."""
    corners: tuple[Int[np.ndarray, "n b valence"], ...]
    """For every energy, the element components that sum to the gradient of an unknown."""

    @property
    def unknowns(self) -> int:
        """n b."""
        return self.blocks * self.width


def pattern(energies: Sequence[ElementEnergy], blocks: int, width: int, free: Any = None) -> Pattern:
    """Returns the sparsity pattern of a sum of element energies on x [blocks, width].

    Args:
        energies: terms of the sum, with their indices.
        blocks: n.
        width: b.
        free: [n, b], True for the unknowns to solve for (default: all).

    Raises:
        InputError: an index is out of range, or occurs twice in an element.
    """
    free = np.ones((blocks, width), bool) if free is None else np.asarray(free, bool)
    if free.shape != (blocks, width):
        raise InputError(f"free has shape {free.shape}; expected one value per unknown, {(blocks, width)}")
    size = blocks * width
    rows_of, columns_of, corners = [], [], []
    for number, indices in enumerate(energy.indices for energy in energies):
        _require_indices(indices, blocks, number)
        unknowns = (indices[:, :, None] * width + np.arange(width)).reshape(len(indices), -1).T
        row, column = np.tril_indices(len(unknowns))
        rows_of.append(unknowns[row].ravel())
        columns_of.append(unknowns[column].ravel())
        corners.append(_group(unknowns.ravel(), np.arange(unknowns.size), size, unknowns.size))
    row, column = np.concatenate(rows_of), np.concatenate(columns_of)
    row, column = np.maximum(row, column), np.minimum(row, column)
    place = np.arange(len(row))
    kept = free.ravel()[row] & free.ravel()[column]
    entries, sources = _group_by_count(row[kept] * size + column[kept], place[kept], len(row))
    rows, columns = np.divmod(entries, size)
    diagonal = np.full(size, len(rows))
    on_diagonal = np.flatnonzero(rows == columns)
    diagonal[rows[on_diagonal]] = on_diagonal
    corner_tables = tuple(table.reshape(blocks, width, -1) for table in corners)
    return Pattern(blocks, width, free, rows, columns, sources, diagonal, corner_tables)


def value_and_gradient(
    energies: Sequence[ElementEnergy], at: Pattern, x: Blocks, data: Sequence[Any]
) -> tuple[Float[Array, ""], Blocks]:
    """Returns E(x), and dE/dx with zeros where x is not free."""
    total, gradient = jnp.zeros((), x.dtype), jnp.zeros_like(x)
    for element, corners, of_elements in zip(energies, at.corners, data, strict=True):
        values, slopes = values_and_slopes(element, x, of_elements)
        total += values.sum()
        gradient += assemble(corners, slopes)
    return total, gradient if at.free.all() else jnp.where(at.free, gradient, 0)


def assemble(corners: Int[np.ndarray, "n b valence"], components: Float[Array, "s m"]) -> Blocks:
    """Adds the components of the elements' corners to the blocks of these corners."""
    if corners.shape[2] == 1 and np.array_equal(corners[:, :, 0].T.ravel(), np.arange(components.size)):
        return components.T.reshape(corners.shape[:2])
    padding = components.size
    # The transposed map gathers from the unknown of each component. JAX's own transpose would scatter, which costs a
    # loop iteration per element on a CPU.
    unknown, slot = np.divmod(np.flatnonzero(corners.reshape(-1) < padding), corners.shape[2])
    to = np.empty(padding, int)
    to[corners.reshape(-1, corners.shape[2])[unknown, slot]] = unknown

    def add(flat: Array) -> Array:
        return jnp.append(flat, 0)[corners].sum(-1).reshape(-1)

    # The transpose of y = G x should also be a gather. So y is written as the second half of the solution of [[1, 0],
    # [-G, 1]] (u, w) = (x, 0),    with the transposed solution u = x + Gᵀ w, because JAX lets callers define the
    # transpose of a linear solve, and can batch it.
    def product(both: Array) -> Array:
        return jnp.concatenate([both[:padding], both[padding:] - add(both[:padding])])

    def solve(_: Callable, both: Array) -> Array:
        return jnp.concatenate([both[:padding], both[padding:] + add(both[:padding])])

    def solve_transposed(_: Callable, both: Array) -> Array:
        return jnp.concatenate([both[:padding] + both[padding:][to], both[padding:]])

    both = jnp.concatenate([components.reshape(-1), jnp.zeros(corners[..., 0].size, components.dtype)])
    solution = jax.lax.custom_linear_solve(product, both, solve, transpose_solve=solve_transposed)
    return solution[padding:].reshape(corners.shape[:2])


def entries(at: Pattern, hessians: Sequence[Array]) -> Float[Array, " entries"]:
    """Returns the lower triangle of the Hessian at `at.rows`, `at.columns`, from the element Hessians."""
    flat = jnp.concatenate([*(h.reshape(-1) for h in hessians), jnp.zeros(1, hessians[0].dtype)])
    return jnp.concatenate([flat[of_group].sum(-1) for of_group in at.sources])


def _group(key: np.ndarray, place: np.ndarray, keys: int, padding: int) -> Int[np.ndarray, "keys terms"]:
    """Returns the places of the keys 0 .. keys - 1 in a padded table."""
    counts = np.bincount(key, minlength=keys)
    table = np.full((keys, max(1, counts.max(initial=0))), padding)
    slots = np.arange(table.shape[1])
    filled = slots < counts[:, None]
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    order = np.argsort(key, kind="stable")
    table[filled] = place[order][(first[:, None] + slots)[filled]]
    return table


def _group_by_count(
    key: np.ndarray, place: np.ndarray, padding: int
) -> tuple[np.ndarray, tuple[Int[np.ndarray, "some terms"], ...]]:
    """Returns the distinct keys and their places in two tables: keys with few places, then the rest."""
    distinct, number, counts = np.unique(key, return_inverse=True, return_counts=True)
    table = _group(number, place, len(distinct), padding)
    few = counts <= np.median(counts)
    chosen = [choice for choice in (few, ~few) if choice.any()]
    tables = tuple(table[choice][:, : counts[choice].max()] for choice in chosen)
    return np.concatenate([distinct[choice] for choice in chosen]), tables


def _require_indices(indices: np.ndarray, blocks: int, number: int) -> None:
    wrong = np.argwhere((indices < 0) | (indices >= blocks))
    if len(wrong):
        element = wrong[0][0]
        raise InputError(
            f"element {element} of energy {number} has indices {indices[element]}; expected 0..{blocks - 1}"
        )
    ordered = np.sort(indices, axis=1)
    twice = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if len(twice):
        raise InputError(
            f"element {twice[0]} of energy {number} has indices {indices[twice[0]]}; expected each index at most once"
        )
