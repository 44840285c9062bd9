"""Sums of element energies, and the derivatives of each element.

    E(x) = sum over energies, sum over elements e:  energy(x[indices[e]], data[e]),    x [n, b]

An element couples a few of the n blocks of b unknowns (the corners of a triangle, the ends of a spring), so that
the Hessian is sparse; `assembly` puts it together.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dln_jax.solvers.lapack import cholesky, symmetric_eigen

# Elements that are decomposed at a time, at most.
_DECOMPOSED = 64

Blocks = Float[Array, "n b"]
Corners = Sequence[Sequence[Array]] | Float[Array, "k b"]
"""x[i][j]: unknown j of corner i, a scalar; `jnp.stack` makes vectors of it. An array [k, b] reads the same."""


class ElementEnergy(NamedTuple):
    """A sum of one scalar function over elements."""

    energy: Callable[[Any, Any], Float[Array, ""]]
    """(unknowns x[i][j] of one element, its data) -> energy."""
    indices: Int[np.ndarray, "m k"]
    """Blocks of unknowns of the elements; a block occurs at most once in an element."""
    unrolled: bool = False
    """Whether the energy takes scalars (`Corners`) instead of an array [k, b]. Arithmetic of scalars fuses over all
    elements and makes derivatives several times faster, for elements of up to a dozen unknowns."""


def value(energies: Sequence[ElementEnergy], x: Blocks, data: Sequence[Any]) -> Float[Array, ""]:
    """Returns E(x)."""
    terms = [jax.vmap(e.energy)(local(e, x), d).sum() for e, d in zip(energies, data, strict=True)]
    return sum(terms, jnp.zeros((), x.dtype))


def local(element: ElementEnergy, x: Blocks) -> Any:
    """Returns the unknowns of all elements in the form that the energy takes: [m, k, b], or nested tuples of [m]."""
    if not element.unrolled:
        return x[element.indices]
    corners = (_take(x, corner) for corner in element.indices.T)
    return tuple(tuple(corner[:, j] for j in range(x.shape[1])) for corner in corners)


def element_hessians(energies: Sequence[ElementEnergy], x: Blocks, data: Sequence[Any]) -> tuple[Array, ...]:
    """Returns the lower triangles of the element Hessians, by rows: [s (s + 1)/2, m] per energy, s = k b."""
    return tuple(
        _unrolled_hessians(e, x, of) if e.unrolled else _array_hessians(e, x, of)
        for e, of in zip(energies, data, strict=True)
    )


def square(lower: Float[Array, "entries m"]) -> Float[Array, "m s s"]:
    """Returns whole element Hessians from their lower triangles."""
    s = round((np.sqrt(8 * lower.shape[0] + 1) - 1) / 2)
    row, column = np.indices((s, s))
    larger, smaller = np.maximum(row, column), np.minimum(row, column)
    return lower.T[:, larger * (larger + 1) // 2 + smaller]


def lower_triangles(whole: Float[Array, "m s s"]) -> Float[Array, "entries m"]:
    """Returns the lower triangles of whole element Hessians, the inverse of `square`."""
    return whole[:, *np.tril_indices(whole.shape[-1])].T


def _array_hessians(element: ElementEnergy, x: Blocks, data: Any) -> Float[Array, "entries m"]:
    s = element.indices.shape[1] * x.shape[1]
    whole = jax.vmap(jax.hessian(element.energy))(local(element, x), data)
    return lower_triangles(whole.reshape(-1, s, s))


def _unrolled_hessians(element: ElementEnergy, x: Blocks, data: Any) -> Float[Array, "entries m"]:
    def of_one(corners: Corners, data: Any) -> list[Array]:
        scalars, structure = jax.tree.flatten(corners)

        def gradient(*scalars: Array) -> list[Array]:
            return jax.tree.leaves(jax.grad(element.energy)(structure.unflatten(scalars), data))

        _, product = jax.linearize(gradient, *scalars)
        one, zero = jnp.ones_like(scalars[0]), jnp.zeros_like(scalars[0])
        columns = [product(*(one if i == j else zero for i in range(len(scalars)))) for j in range(len(scalars))]
        return [columns[j][i] for i in range(len(scalars)) for j in range(i + 1)]

    return jnp.stack(jax.vmap(of_one)(local(element, x), data))


def _take(x: Blocks, blocks: np.ndarray) -> Float[Array, "m b"]:
    return x if np.array_equal(blocks, np.arange(len(x))) else x[blocks]


def project(hessians: Sequence[Array], shift: Float[Array, ""]) -> tuple[Array, ...]:
    """Sets negative eigenvalues of element Hessians (lower triangles) to zero, and shifts their diagonals.

    `shift` is relative to the largest diagonal entry of all elements. Elements whose Hessian is positive definite with
    half of the shift keep it: only the others are decomposed.
    """
    whole = [jnp.where(jnp.isfinite(h), h, 0) for h in map(square, hessians)]
    largest = functools.reduce(jnp.maximum, [jnp.max(jnp.diagonal(h, axis1=1, axis2=2), initial=0) for h in whole])
    return tuple(lower_triangles(_projected(h, shift * largest)) for h in whole)


def _projected(hessians: Float[Array, "m s s"], shift: Float[Array, ""]) -> Float[Array, "m s s"]:
    m, s, _ = hessians.shape
    if not m:
        return hessians
    count = min(_DECOMPOSED, m)
    unit = jnp.eye(s, dtype=hessians.dtype)
    definite = jnp.isfinite(jax.vmap(cholesky)(hessians + shift / 2 * unit)).all(axis=(1, 2))
    # Places of the others first; places past the end are read as the last element, and not written.
    order = jnp.append(jnp.argsort(definite), jnp.full(count, m))

    def decompose(number: Array, hessians: Array) -> Array:
        at = jax.lax.dynamic_slice_in_dim(order, number * count, count)
        values, vectors = jax.vmap(symmetric_eigen)(hessians.at[at].get(mode="clip"))
        semidefinite = (vectors * jnp.maximum(values, 0)[:, None, :]) @ vectors.swapaxes(-1, -2)
        return hessians.at[at].set(semidefinite, mode="drop")

    rounds = -(-jnp.sum(~definite) // count)
    return jax.lax.fori_loop(0, rounds, decompose, hessians) + shift * unit
