"""Positive semi-definite projections of element Hessians."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.solvers.elements.energies import lower_triangles, square


def project(hessians: Sequence[Array], shift: Float[Array, ""]) -> tuple[Array, ...]:
    """Element Hessians with their negative eigenvalues set to zero, plus a multiple of the unit matrix.

    Args:
        hessians: lower triangles of the elements of each energy, of any sizes.
        shift: what is added to the diagonals, relative to the largest eigenvalue of all.
    """
    wholes = [square(lower) for lower in hessians]
    largest = max(h.shape[-1] for h in wholes)
    # One call for all: several batched LAPACK calls in one program can wait for each other for ever.
    padded = [jnp.pad(h, ((0, 0), (0, largest - h.shape[-1]), (0, largest - h.shape[-1]))) for h in wholes]
    stacked = jnp.concatenate(padded)
    finite = jnp.where(jnp.isfinite(stacked), stacked, 0)
    values, vectors = jnp.linalg.eigh(finite)
    values = jnp.maximum(values, 0) + shift * jnp.max(values, initial=0)
    projected = (vectors * values[:, None, :]) @ vectors.swapaxes(-1, -2)
    ends = [0]
    for h in wholes:
        ends.append(ends[-1] + len(h))
    return tuple(
        lower_triangles(projected[a:b, : h.shape[-1], : h.shape[-1]])
        for a, b, h in zip(ends, ends[1:], wholes, strict=False)
    )
