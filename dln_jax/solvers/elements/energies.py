"""Sums of element energies, and the derivatives of each element.

    E(x) = sum over energies, sum over elements e:  energy(x[indices[e]], data[e]),    x [n, b]

An element couples a few of the n blocks of b unknowns (the corners of a triangle, the ends of a spring), so the Hessian
is sparse. `assembly` adds up the elements.
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dln_jax.solvers.elimination import cholesky, symmetric_eigen

# Largest number of elements decomposed at a time.
_DECOMPOSED = 64
# Largest element Hessians projected in one batch.
_SMALL = 36

Blocks = Float[Array, "n b"]
Corners = Sequence[Sequence[Array]] | Float[Array, "k b"]
"""x[i][j]: unknown j of corner i, a scalar; `jnp.stack` makes vectors of them. An array [k, b] reads the same."""


class ElementEnergy(NamedTuple):
    """A sum of one scalar function over elements."""

    energy: Callable[[Any, Any], Float[Array, ""]]
    """(unknowns x[i][j] of one element, or their combinations, its data) -> energy."""
    indices: Int[np.ndarray, "m k"]
    """Blocks of unknowns of every element; a block occurs at most once per element."""
    unrolled: bool = False
    """True if the energy takes scalars (`Corners`) instead of an array [k, b]. Scalar arithmetic fuses over all
    elements, so derivatives are several times faster for elements of up to a dozen unknowns."""
    weights: Callable[[Any], Any] | None = None
    """Data of one element -> w[k][j], for an energy of the combinations y[i][j] = sum over corners k of x[k][i]
    w[k][j], such as a deformation gradient or an edge. The Hessian by y is smaller. Only if unrolled."""


def value(energies: Sequence[ElementEnergy], x: Blocks, data: Sequence[Any]) -> Float[Array, ""]:
    """Returns E(x)."""
    total = jnp.zeros((), x.dtype)
    for element, of in zip(energies, data, strict=True):
        if element.unrolled:
            values = _by_scalars(element.energy, *_arguments(element, x, of), x.shape[1], of)
        else:
            values = jax.vmap(element.energy)(x[element.indices], of)
        total += values.sum()
    return total


def values_and_slopes(element: ElementEnergy, x: Blocks, data: Any) -> tuple[Float[Array, " m"], Float[Array, "s m"]]:
    """Returns the energies of all elements and their derivatives by the unknowns at the corners, s = k b."""
    if not element.unrolled:
        values, slopes = jax.vmap(jax.value_and_grad(element.energy))(x[element.indices], data)
        return values, slopes.reshape(len(slopes), -1).T
    y, w = _arguments(element, x, data)
    values, slopes = _by_scalars(jax.value_and_grad(element.energy), y, w, x.shape[1], data)
    slopes = jnp.stack(jax.tree.leaves(slopes))
    if w is None:
        return values, slopes
    by_rows = slopes.reshape(x.shape[1], w.shape[1], -1)
    by_corners = _added(by_rows[:, j] * w[:, None, j] for j in range(w.shape[1]))
    return values, by_corners.reshape(-1, slopes.shape[1])


def of_corners(element: ElementEnergy) -> Callable[[Any, Any], Float[Array, ""]]:
    """Returns the energy as a function of the unknowns at the corners, (x[k][i] of one element, its data) -> energy."""
    weights = element.weights
    if weights is None:
        return element.energy
    return lambda x, data: element.energy(combinations(x, weights(data)), data)


def combinations(x: Corners, weights: Any) -> list[list[Array]]:
    """Returns y[i][j] = sum over corners k of x[k][i] w[k][j] for one element."""
    corners, width, columns = range(len(x)), range(len(x[0])), range(len(weights[0]))
    return [[jnp.asarray(sum(x[k][i] * weights[k][j] for k in corners)) for j in columns] for i in width]


def local(element: ElementEnergy, x: Blocks) -> Any:
    """Returns the unknowns of all elements as the energy takes them: [m, k, b], or nested tuples of [m]."""
    if not element.unrolled:
        return x[element.indices]
    corners = (_take(x, corner) for corner in element.indices.T)
    return tuple(tuple(corner[:, j] for j in range(x.shape[1])) for corner in corners)


def element_hessians(energies: Sequence[ElementEnergy], x: Blocks, data: Sequence[Any]) -> tuple[Array, ...]:
    """Returns the lower triangles of the element Hessians, by rows: [s (s + 1)/2, m] per energy, s = k b."""
    return tuple(_hessians(element, x, of) for element, of in zip(energies, data, strict=True))


def square(lower: Float[Array, "entries m"]) -> Float[Array, "m s s"]:
    """Returns whole element Hessians from their lower triangles."""
    s = round((np.sqrt(8 * lower.shape[0] + 1) - 1) / 2)
    row, column = np.indices((s, s))
    larger, smaller = np.maximum(row, column), np.minimum(row, column)
    return lower.T[:, larger * (larger + 1) // 2 + smaller]


def lower_triangles(whole: Float[Array, "m s s"]) -> Float[Array, "entries m"]:
    """Returns the lower triangles of whole element Hessians, the inverse of `square`."""
    return whole[:, *np.tril_indices(whole.shape[-1])].T


def _hessians(element: ElementEnergy, x: Blocks, data: Any) -> Float[Array, "entries m"]:
    if not element.unrolled:
        s = element.indices.shape[1] * x.shape[1]
        whole = jax.vmap(jax.hessian(element.energy))(local(element, x), data)
        return lower_triangles(whole.reshape(-1, s, s))
    y, w = _arguments(element, x, data)

    def slope(y: Float[Array, "s m"]) -> Float[Array, "s m"]:
        return _by_scalars(jax.grad(element.energy), y, w, x.shape[1], data)

    _, product = jax.linearize(slope, y)
    # All columns of all elements at once, elements last: compiling column by column takes several times longer.
    unit = jnp.broadcast_to(jnp.eye(len(y), dtype=x.dtype)[:, :, None], (len(y), *y.shape))
    whole = jax.vmap(product)(unit)
    if w is not None:
        # Sums over whole arrays: products of small matrices run several times slower.
        (corners, columns, _), width = w.shape, x.shape[1]
        split = whole.reshape(width, columns, width, columns, -1)
        half = _added(split[:, :, :, None, j] * w[:, j] for j in range(columns))
        full = _added(w[:, None, j, None, None] * half[:, j].swapaxes(1, 2) for j in range(columns))
        whole = full.reshape(corners * width, corners * width, -1)
    return whole[np.tril_indices(len(whole))]


def _arguments(element: ElementEnergy, x: Blocks, data: Any) -> tuple[Float[Array, "s m"], Array | None]:
    """Returns the scalars that an unrolled energy takes, elements last, and its weights [k, j, m], if any."""
    corners = jnp.stack([_take(x, corner).T for corner in element.indices.T])
    weights = element.weights
    if weights is None:
        return corners.reshape(-1, corners.shape[2]), None
    w = jnp.moveaxis(jax.vmap(lambda data: jnp.asarray(weights(data), x.dtype))(data), 0, -1)
    y = _added(corner[:, None] * of for corner, of in zip(corners, w, strict=True))
    return y.reshape(-1, y.shape[2]), w


def _added(parts: Iterable[Array]) -> Array:
    return functools.reduce(jnp.add, parts)


def _by_scalars(function: Callable, y: Float[Array, "s m"], w: Array | None, width: int, data: Any) -> Any:
    """Maps a function of one element's nested scalars and data over all elements, and stacks its results."""
    columns = width if w is None else w.shape[1]
    rows = [list(y[start : start + columns]) for start in range(0, len(y), columns)]
    results = jax.vmap(function)(rows, data)
    return jnp.stack(jax.tree.leaves(results)) if isinstance(results, list) else results


def _take(x: Blocks, blocks: np.ndarray) -> Float[Array, "m b"]:
    return x if np.array_equal(blocks, np.arange(len(x))) else x[blocks]


def project(hessians: Sequence[Array], shift: Float[Array, ""]) -> tuple[Array, ...]:
    """Sets negative eigenvalues of element Hessians (lower triangles) to zero, and shifts their diagonals.

    `shift` is relative to the largest diagonal entry of all elements. An element keeps its Hessian if half of the shift
    makes it positive definite; only the others are decomposed.
    """
    whole = [jnp.where(jnp.isfinite(h), h, 0) for h in map(square, hessians)]
    largest = functools.reduce(jnp.maximum, [jnp.max(jnp.diagonal(h, axis1=1, axis2=2), initial=0) for h in whole])
    # Small elements of all kinds form one batch, padded with zeros: one program instead of one per kind.
    small = [number for number, h in enumerate(whole) if h.shape[1] <= _SMALL]
    if len(small) > 1:
        width = max(whole[number].shape[1] for number in small)
        padding = [((0, 0), *2 * [(0, width - whole[number].shape[1])]) for number in small]
        batch = jnp.concatenate([jnp.pad(whole[number], pad) for number, pad in zip(small, padding, strict=True)])
        parts = jnp.split(_projected(batch, shift * largest), np.cumsum([len(whole[n]) for n in small])[:-1])
        done = {n: part[:, : whole[n].shape[1], : whole[n].shape[1]] for n, part in zip(small, parts, strict=True)}
    else:
        done = {}
    return tuple(lower_triangles(done[n] if n in done else _projected(h, shift * largest)) for n, h in enumerate(whole))


def _projected(hessians: Float[Array, "m s s"], shift: Float[Array, ""]) -> Float[Array, "m s s"]:
    m, s, _ = hessians.shape
    if not m:
        return hessians
    count = min(_DECOMPOSED, m)
    unit = jnp.eye(s, dtype=hessians.dtype)
    definite = jnp.isfinite(jax.vmap(cholesky)(hessians + shift / 2 * unit)).all(axis=(1, 2))
    # Elements to decompose come first. Places past the end read the last element and are not written.
    order = jnp.append(jnp.argsort(definite), jnp.full(count, m))

    def decompose(number: Array, hessians: Array) -> Array:
        at = jax.lax.dynamic_slice_in_dim(order, number * count, count)
        values, vectors = jax.vmap(symmetric_eigen)(hessians.at[at].get(mode="clip"))
        semidefinite = (vectors * jnp.maximum(values, 0)[:, None, :]) @ vectors.swapaxes(-1, -2)
        return hessians.at[at].set(semidefinite, mode="drop")

    rounds = -(-jnp.sum(~definite) // count)
    return jax.lax.fori_loop(0, rounds, decompose, hessians) + shift * unit
