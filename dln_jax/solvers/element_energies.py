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

from dln_jax.types import InputError

Blocks = Float[Array, "n b"]


class ElementEnergy(NamedTuple):
    """A sum of one scalar function over elements."""

    energy: Callable[[Float[Array, "k b"], Any], Float[Array, ""]]
    """(unknowns of one element, its data) -> energy."""
    indices: Int[np.ndarray, "m k"]
    """Blocks of unknowns of each element; an element may name a block once."""


class Pattern(NamedTuple):
    """Where the entries of the lower triangle of the Hessian come from. Static arrays.

    Unknown number `r` is x.ravel()[r]. `sources` index the concatenated, raveled element Hessians of all energies;
    one past their end is a zero.
    """

    blocks: int
    """n."""
    width: int
    """b."""
    free: Bool[np.ndarray, "n b"]
    """Unknowns that are solved for."""
    rows: Int[np.ndarray, " entries"]
    columns: Int[np.ndarray, " entries"]
    """Of each entry; columns <= rows."""
    sources: tuple[Int[np.ndarray, "some terms"], ...]
    """Element entries that add up to each entry, for entries 0, 1, ... in turn, grouped by how many there are."""
    corners: tuple[Int[np.ndarray, "n valence"], ...]
    """For each energy, the corners (element * k + corner) at each block; padded with m * k."""

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
    keys, offset = [], 0
    places = []
    for number, (_, indices) in enumerate(energies):
        _require_indices(indices, blocks, number)
        unknowns = (indices[:, :, None] * width + np.arange(width)).reshape(len(indices), -1)
        m, size = unknowns.shape
        keys.append((unknowns[:, :, None] * blocks * width + unknowns[:, None, :]).ravel())
        places.append(offset + np.arange(m * size * size))
        offset += m * size * size
    key, place = np.concatenate(keys), np.concatenate(places)
    row, column = np.divmod(key, blocks * width)
    kept = (column <= row) & free.ravel()[row] & free.ravel()[column]
    entries, sources = _group(key[kept], place[kept], padding=offset)
    rows, columns = np.divmod(entries, blocks * width)
    corners = tuple(_corners(indices, blocks) for _, indices in energies)
    return Pattern(blocks, width, free, rows, columns, sources, corners)


def value(energies: Sequence[ElementEnergy], x: Blocks, data: Sequence[Any]) -> Float[Array, ""]:
    """E(x)."""
    terms = [jax.vmap(e.energy)(x[e.indices], d).sum() for e, d in zip(energies, data, strict=True) if len(e.indices)]
    return sum(terms, jnp.zeros((), x.dtype))


def value_and_gradient(
    energies: Sequence[ElementEnergy], at: Pattern, x: Blocks, data: Sequence[Any]
) -> tuple[Float[Array, ""], Blocks]:
    """E(x), and dE/dx with zeros where x is not free."""
    total, gradient = jnp.zeros((), x.dtype), jnp.zeros_like(x)
    for (energy, indices), corners, of_elements in zip(energies, at.corners, data, strict=True):
        if len(indices):
            values, gradients = jax.vmap(jax.value_and_grad(energy))(x[indices], of_elements)
            total += values.sum()
            gradient += assemble(corners, gradients)
    return total, gradient if at.free.all() else jnp.where(at.free, gradient, 0)


def gradient(energies: Sequence[ElementEnergy], at: Pattern, x: Blocks, data: Sequence[Any]) -> Blocks:
    """dE/dx, with zeros where x is not free."""
    return value_and_gradient(energies, at, x, data)[1]


def assemble(corners: Int[np.ndarray, "n valence"], of_corners: Float[Array, "m k b"]) -> Blocks:
    """Adds what the elements have at their corners to the blocks there."""
    flat = of_corners.reshape(-1, of_corners.shape[-1])
    # Summed slice by slice: a reduction over a short axis is slower than additions.
    return sum(
        (jnp.take(flat, column, axis=0, mode="fill", fill_value=0) for column in corners.T[1:]),
        jnp.take(flat, corners[:, 0], axis=0, mode="fill", fill_value=0),
    )


def element_hessians(energies: Sequence[ElementEnergy], x: Blocks, data: Sequence[Any]) -> tuple[Array, ...]:
    """The Hessian of each element, [m, k b, k b], for each energy."""
    hessians = []
    for (energy, indices), of_elements in zip(energies, data, strict=True):
        size = indices.shape[1] * x.shape[1]
        second = jax.vmap(jax.hessian(energy))(x[indices], of_elements)
        hessians.append(second.reshape(len(indices), size, size))
    return tuple(hessians)


def entries(at: Pattern, hessians: Sequence[Array]) -> Float[Array, " entries"]:
    """Values of the Hessian's lower triangle at `at.rows`, `at.columns`, from the Hessians of the elements."""
    dtype = hessians[0].dtype
    flat = jnp.concatenate([*(h.reshape(-1) for h in hessians), jnp.zeros(1, dtype)])
    return jnp.concatenate([sum((flat[s] for s in of_group.T[1:]), flat[of_group[:, 0]]) for of_group in at.sources])


def _group(
    key: np.ndarray, place: np.ndarray, padding: int
) -> tuple[np.ndarray, tuple[Int[np.ndarray, "some terms"], ...]]:
    """Distinct keys, and the places of each, in two padded tables: keys with few places, then the rest."""
    order = np.argsort(key, kind="stable")
    distinct, first, counts = np.unique(key[order], return_index=True, return_counts=True)
    few = counts <= np.median(counts)
    tables, sorted_keys = [], []
    for chosen in (few, ~few):
        if chosen.any():
            table = np.full((chosen.sum(), counts[chosen].max()), padding)
            slots = np.arange(table.shape[1])
            filled = slots < counts[chosen][:, None]
            table[filled] = place[order][(first[chosen][:, None] + slots)[filled]]
            tables.append(table)
            sorted_keys.append(distinct[chosen])
    return np.concatenate(sorted_keys), tuple(tables)


def _corners(indices: np.ndarray, blocks: int) -> Int[np.ndarray, "n valence"]:
    flat = indices.ravel()
    valence = np.bincount(flat, minlength=blocks)
    table = np.full((blocks, max(1, valence.max(initial=0))), len(flat))
    order = np.argsort(flat, kind="stable")
    slots = np.arange(table.shape[1])
    first = np.concatenate([[0], np.cumsum(valence)[:-1]])
    filled = slots < valence[:, None]
    table[filled] = order[(first[:, None] + slots)[filled]]
    return table


def _require_indices(indices: np.ndarray, blocks: int, number: int) -> None:
    wrong = np.argwhere((indices < 0) | (indices >= blocks))
    if len(wrong):
        element = wrong[0][0]
        raise InputError(f"element {element} of energy {number} has indices {indices[element]}; expected 0..{blocks - 1}")
    ordered = np.sort(indices, axis=1)
    twice = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if len(twice):
        raise InputError(f"element {twice[0]} of energy {number} has indices {indices[twice[0]]}; expected each once")
