"""Sums of element energies, and how their gradients and Hessians are put together.

    E(x) = sum over energies, sum over elements e:  energy(x[indices[e]], data[e]),    x [n, b]

An element couples a few of the n blocks of b unknowns each (the corners of a triangle, the ends of a spring), so that
the Hessian is sparse. Which elements meet where is known before anything is traced: assembly is by gathering and adding
along index arrays made here once, because scattering costs a loop iteration per element.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dln_jax.solvers.linear_map import linear_map
from dln_jax.types import InputError

Blocks = Float[Array, "n b"]
Corners = Sequence[Sequence[Array]] | Float[Array, "k b"]
"""x[i][j]: unknown j of corner i, a scalar; `jnp.stack` makes vectors of it. An array [k, b] reads the same."""


class ElementEnergy(NamedTuple):
    """A sum of one scalar function over elements."""

    energy: Callable[[Any, Any], Float[Array, ""]]
    """(unknowns x[i][j] of one element, its data) -> energy."""
    indices: Int[np.ndarray, "m k"]
    """Blocks of unknowns of each element; an element may name a block once."""
    written_out: bool = False
    """Whether the energy takes `Corners`, scalars in place of an array [k, b]: arithmetic of scalars fuses over all
    elements, so that its derivatives are several times faster; for elements of up to a dozen unknowns."""


class Pattern(NamedTuple):
    """Where the gradient and the lower triangle of the Hessian come from. Static arrays.

    Unknown number `r` is x.ravel()[r]. Sources index what the elements have, component by component (all elements'
    first, then all elements' second, ...); one past the end stands for zero.
    """

    blocks: int
    """n."""
    width: int
    """b."""
    free: Bool[np.ndarray, "n b"]
    """Unknowns that are solved for."""
    rows: Int[np.ndarray, " entries"]
    columns: Int[np.ndarray, " entries"]
    """Of each entry of the Hessian; columns <= rows."""
    sources: tuple[Int[np.ndarray, "some terms"], ...]
    """Element entries that add up to each entry, for entries 0, 1, ... in turn, grouped by how many there are."""
    diagonal: Int[np.ndarray, " unknowns"]
    """Place of each unknown's diagonal entry among the entries; one past the end where it is not free."""
    corners: tuple[Int[np.ndarray, "n b valence"], ...]
    """For each energy, the element components that add up to each unknown's."""

    @property
    def unknowns(self) -> int:
        """n b."""
        return self.blocks * self.width


def pattern(energies: Sequence[ElementEnergy], blocks: int, width: int, free: Any = None) -> Pattern:
    """The sparsity pattern of a sum of element energies on x [blocks, width].

    Args:
        energies: whose indices count.
        blocks: n.
        width: b.
        free: [n, b], which unknowns are solved for; all of them by default.

    Raises:
        InputError: an index that is out of range, or named twice by one element.
    """
    free = np.ones((blocks, width), bool) if free is None else np.asarray(free, bool)
    if free.shape != (blocks, width):
        raise InputError(f"free has shape {free.shape}; expected one value per unknown, {(blocks, width)}")
    size = blocks * width
    rows_of, columns_of, corners = [], [], []
    for number, (_, indices, _) in enumerate(energies):
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


def value(energies: Sequence[ElementEnergy], x: Blocks, data: Sequence[Any]) -> Float[Array, ""]:
    """E(x)."""
    terms = [jax.vmap(e.energy)(local(e, x), d).sum() for e, d in zip(energies, data, strict=True)]
    return sum(terms, jnp.zeros((), x.dtype))


def value_and_gradient(
    energies: Sequence[ElementEnergy], at: Pattern, x: Blocks, data: Sequence[Any]
) -> tuple[Float[Array, ""], Blocks]:
    """E(x), and dE/dx with zeros where x is not free."""
    total, gradient = jnp.zeros((), x.dtype), jnp.zeros_like(x)
    for element, corners, of_elements in zip(energies, at.corners, data, strict=True):
        values, gradients = jax.vmap(jax.value_and_grad(element.energy))(local(element, x), of_elements)
        total += values.sum()
        gradient += assemble(corners, _components(gradients))
    return total, gradient if at.free.all() else jnp.where(at.free, gradient, 0)


def gradient(energies: Sequence[ElementEnergy], at: Pattern, x: Blocks, data: Sequence[Any]) -> Blocks:
    """dE/dx, with zeros where x is not free."""
    return value_and_gradient(energies, at, x, data)[1]


def local(element: ElementEnergy, x: Blocks) -> Any:
    """The unknowns of all elements, as the energy takes them: [m, k, b], or scalars [m] in nested tuples."""
    if not element.written_out:
        return x[element.indices]
    corners = (_take(x, corner) for corner in element.indices.T)
    return tuple(tuple(corner[:, j] for j in range(x.shape[1])) for corner in corners)


def assemble(corners: Int[np.ndarray, "n b valence"], components: Float[Array, "s m"]) -> Blocks:
    """Adds what the elements have at their corners to the blocks there."""
    if corners.shape[2] == 1 and np.array_equal(corners[:, :, 0].T.ravel(), np.arange(components.size)):
        return components.T.reshape(corners.shape[:2])
    padding = components.size
    # Where each component goes; the transposed map reads there, where differentiation would scatter.
    unknown, slot = np.divmod(np.flatnonzero(corners.reshape(-1) < padding), corners.shape[2])
    to = np.empty(padding, int)
    to[corners.reshape(-1, corners.shape[2])[unknown, slot]] = unknown

    def add(flat: Array) -> Array:
        return jnp.append(flat, 0)[corners].sum(-1).reshape(-1)

    def read(unknowns: Array) -> Array:
        return unknowns[to]

    return linear_map(add, read, components.reshape(-1), corners[..., 0].size).reshape(corners.shape[:2])


def element_hessians(energies: Sequence[ElementEnergy], x: Blocks, data: Sequence[Any]) -> tuple[Array, ...]:
    """Lower triangles of the Hessian of each element, row by row: [s (s + 1)/2, m] for each energy, s = k b."""
    return tuple(
        _written_out_hessians(e, x, of) if e.written_out else _array_hessians(e, x, of)
        for e, of in zip(energies, data, strict=True)
    )


def entries(at: Pattern, hessians: Sequence[Array]) -> Float[Array, " entries"]:
    """Values of the Hessian's lower triangle at `at.rows`, `at.columns`, from the Hessians of the elements."""
    flat = jnp.concatenate([*(h.reshape(-1) for h in hessians), jnp.zeros(1, hessians[0].dtype)])
    return jnp.concatenate([flat[of_group].sum(-1) for of_group in at.sources])


def square(lower: Float[Array, "entries m"]) -> Float[Array, "m s s"]:
    """Whole element Hessians from their lower triangles."""
    s = round((np.sqrt(8 * lower.shape[0] + 1) - 1) / 2)
    row, column = np.indices((s, s))
    larger, smaller = np.maximum(row, column), np.minimum(row, column)
    return lower.T[:, larger * (larger + 1) // 2 + smaller]


def lower_triangles(whole: Float[Array, "m s s"]) -> Float[Array, "entries m"]:
    """The inverse of `square`."""
    return whole[:, *np.tril_indices(whole.shape[-1])].T


def _array_hessians(element: ElementEnergy, x: Blocks, data: Any) -> Float[Array, "entries m"]:
    s = element.indices.shape[1] * x.shape[1]
    whole = jax.vmap(jax.hessian(element.energy))(local(element, x), data)
    return lower_triangles(whole.reshape(-1, s, s))


def _written_out_hessians(element: ElementEnergy, x: Blocks, data: Any) -> Float[Array, "entries m"]:
    def of_one(corners: Corners, data: Any) -> list[Array]:
        scalars, structure = jax.tree.flatten(corners)

        def gradient(*scalars: Array) -> list[Array]:
            return jax.tree.leaves(jax.grad(element.energy)(structure.unflatten(scalars), data))

        _, product = jax.linearize(gradient, *scalars)
        one, zero = jnp.ones_like(scalars[0]), jnp.zeros_like(scalars[0])
        columns = [product(*(one if i == j else zero for i in range(len(scalars)))) for j in range(len(scalars))]
        return [columns[j][i] for i in range(len(scalars)) for j in range(i + 1)]

    return jnp.stack(jax.vmap(of_one)(local(element, x), data))


def _components(of_corners: Any) -> Float[Array, "s m"]:
    """What `local` gives, component by component."""
    if isinstance(of_corners, tuple):
        return jnp.stack(jax.tree.leaves(of_corners))
    return of_corners.reshape(len(of_corners), -1).T


def _take(x: Blocks, blocks: np.ndarray) -> Float[Array, "m b"]:
    return x if np.array_equal(blocks, np.arange(len(x))) else x[blocks]


def _group(key: np.ndarray, place: np.ndarray, keys: int, padding: int) -> Int[np.ndarray, "keys most"]:
    """The places of each key 0 .. keys - 1, in a padded table."""
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
    """Distinct keys and the places of each, in two tables: keys with few places, then the rest."""
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
        raise InputError(f"element {twice[0]} of energy {number} has indices {indices[twice[0]]}; expected each once")
