"""Principal components of images: fewer numbers with nearly the same distances, up to the variance that is lost.

c = B (x - mean),   x_hat = mean + Bᵀ c,   rows of B [C, n]: the eigenvectors of the covariance, largest first
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.types import InputError


class Components(NamedTuple):
    """An orthonormal basis of images."""

    mean: Float[np.ndarray, " n"]
    basis: Float[np.ndarray, "C n"]
    scale: float
    """Root mean square of a coefficient."""
    lost: float
    """Share of the variance outside the basis."""


def principal_components(images: Float[np.ndarray, "*samples n"], count: int) -> Components:
    """Returns the components with the largest variance.

    Raises:
        InputError: a count outside 1..n.
    """
    n = images.shape[-1]
    if not 1 <= count <= n:
        raise InputError(f"components is {count}; expected 1 to {n}, the numbers of a image")
    flat = images.reshape(-1, n).astype(float)
    mean = flat.mean(axis=0)
    variances, vectors = np.linalg.eigh((flat - mean).T @ (flat - mean) / len(flat))
    kept = variances[-count:].sum()
    return Components(mean, vectors[:, ::-1][:, :count].T, float(np.sqrt(kept / count)), 1 - kept / variances.sum())


def compress(components: Components, images: Float[np.ndarray, "*samples n"]) -> Float[np.ndarray, "*samples C"]:
    """Coefficients of images, in the dtype of the images."""
    return ((images - components.mean) @ components.basis.T).astype(images.dtype)
