"""Posterior of a model's parameters from its training data: the covariance of a least-squares fit, and its noise.

The fit minimises sum over samples and joints of ((tau_hat_i - tau_i) / unit_i)² + ridge |D (theta - theta_0)|², to
first order about the fitted parameters. D holds the norms of the columns of the Jacobian J of the scaled residuals.
With J D⁻¹ = U S Vᵀ, torque noise of variance noise_i², and a prior of variance Sigma / ridge,

    Cov(D theta) = V (S² + ridge)⁻¹ (S Uᵀ Sigma U S + ridge Sigma) (S² + ridge)⁻¹ Vᵀ,   Sigma = diag(noise_i² / unit_i²)

This module has torques in the joints' units `unit_i`, so that J and r need no scale, and noise_i is relative to unit_i.
For ridge = 0 this is the covariance of weighted least squares on the determined directions, for any weights. If all
joints have the same Sigma, it is Laplace's approximation, Sigma (JᵀJ + ridge D²)⁻¹. The degrees of freedom of joint i
are the trace of the hat matrix over its rows:  noise_i² = sum r_i² / (N - dof_i).
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.types import JointVector

Rows = Iterator[tuple[np.ndarray, np.ndarray]]
"""Phi [n, d, P] and tau_hat - tau [n, d] in the joints' units, in chunks of samples."""
ALONE = 1e-6
"""A group of samples alone determines a direction if the others have less than this fraction of the information."""
TINY = float(np.finfo(np.float64).tiny)


class Spectrum(NamedTuple):
    """Singular value decomposition of J D⁻¹, and its factors by joint."""

    scale: Float[np.ndarray, " P"]
    """D."""
    sizes: Float[np.ndarray, " P"]
    """S, zero for undetermined directions."""
    directions: Float[np.ndarray, "P P"]
    """V, in columns."""
    triangles: Float[np.ndarray, "d r P"]
    """J_i D⁻¹ V of each joint, up to a rotation of its rows."""
    squares: JointVector
    """Sums of squared residuals of the joints, in their units."""
    samples: int


class Posterior(NamedTuple):
    """Covariance of the parameters, noise, and number of determined parameters."""

    along: Float[np.ndarray, "K r"]
    """Factor of the covariance of D theta along the directions of the spectrum."""
    noise: JointVector
    """Standard deviations, in the joints' units."""
    degrees_of_freedom: JointVector


def spectrum(rows: Rows, *, negligible: float = 0.0) -> Spectrum:
    """Computes the spectrum of all rows in about N d P² operations, with memory for d P² numbers.

    Args:
        rows: columns and residuals of the training data.
        negligible: as for `solvers.least_squares.solve`.
    """
    triangles, samples = None, 0
    for columns, residual in rows:
        samples += len(residual)
        both = np.concatenate([columns, residual[:, :, None]], axis=2).swapaxes(0, 1)
        both = both if triangles is None else np.concatenate([triangles, both], axis=1)
        triangles = np.linalg.qr(both, mode="r")  # factors of the joints' [Phi_i r_i]
    weighted, residuals = np.split(np.asarray(triangles), [-1], axis=2)
    joints, _, P = weighted.shape
    norms = np.linalg.norm(weighted, axis=(0, 1))
    seen = norms > negligible * norms.max(initial=0.0)
    scale = np.where(seen, norms, 1.0)
    scaled = np.where(seen, weighted, 0.0) / scale
    _, sizes, right = np.linalg.svd(np.linalg.qr(scaled.reshape(-1, P), mode="r"), full_matrices=True)
    sizes = np.concatenate([sizes, np.zeros(P - len(sizes))])
    tolerance = np.finfo(np.float64).eps * max(samples * joints, P)
    sizes = np.where(sizes > tolerance * sizes.max(initial=0.0), sizes, 0.0)
    return Spectrum(scale, sizes, right.T, scaled @ right.T, np.sum(residuals**2, axis=(1, 2)), samples)


def leave_out(
    spectrum: Spectrum,
    noise: JointVector,
    columns: Float[np.ndarray, "n d P"],
    residual: Float[np.ndarray, "n d"],
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
    """Returns leave-out residuals of training samples, and their variance due to the parameters.

    With U the samples' rows of the orthonormal factor of J, r~ = r + U (1 - UᵀU)⁻¹ Uᵀ r, which is exact for least
    squares without a ridge (Cook and Weisberg 1982, "Residuals and influence in regression", section 2.2, for groups).

    Args:
        noise: standard deviations from `posterior`.
        columns: Phi D⁻¹ V of the samples.
        residual: tau_hat - tau of the samples, in the joints' units.
    """
    counts = spectrum.sizes > 0
    U, every = (part[..., counts] / spectrum.sizes[counts] for part in (columns.swapaxes(0, 1), spectrum.triangles))
    values, vectors = np.linalg.eigh(np.eye(U.shape[2]) - gram(U, np.ones_like(noise)))
    # If only these samples determine a direction, its fit is exact and its zero residual carries no information.
    inverse = (vectors * np.divide(1, values, out=np.zeros_like(values), where=values > ALONE)) @ vectors.T
    covariance = inverse @ (gram(every, noise) - gram(U, noise)) @ inverse
    predicted = U @ (inverse @ np.einsum("inp,ni->p", U, residual))
    return residual + predicted.T, np.maximum(np.sum((U @ covariance) * U, axis=2), 0.0).T


def gram(rows: Float[np.ndarray, "d n P"], noise: JointVector) -> Float[np.ndarray, "P P"]:
    """Returns the sum over joints of noise² rowsᵀ rows."""
    weighted = (rows * noise[:, None, None]).reshape(-1, rows.shape[2])
    return weighted.T @ weighted


def leading_directions(rows: Callable[[], Rows], count: int) -> Float[np.ndarray, "P K"]:
    """Returns the best-determined combinations of parameters, for models too large for a full spectrum.

    Subspace iteration on D⁻¹JᵀJ D⁻¹ (Halko, Martinsson and Tropp 2011, algorithm 4.4). Phi times the result is the
    Jacobian of a model with parameters in that subspace only (Izmailov et al. 2020, "Subspace inference").

    Args:
        rows: starts a new pass over the training data at each call.
        count: K.
    """
    squares = sum(np.sum(columns**2, axis=(0, 1)) for columns, _ in rows())
    scale = np.sqrt(np.where(squares > 0, squares, 1.0))
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(len(scale), count)))[0]
    for _ in range(2):
        scaled = ((columns / scale).reshape(-1, len(scale)) for columns, _ in rows())
        basis = np.linalg.qr(sum(part.T @ (part @ basis) for part in scaled))[0]
    return basis / scale[:, None]


def posterior(spectrum: Spectrum, ridge: float) -> Posterior:
    """Returns the posterior for a ridge; with 0, undetermined directions have no variance."""
    counts = (spectrum.sizes > 0) | (ridge > 0)
    damped = np.sqrt(spectrum.sizes[counts] ** 2 + ridge)
    shares = spectrum.triangles[..., counts] / damped
    dof = np.sum(shares**2, axis=(1, 2))
    noise = np.sqrt(spectrum.squares / np.maximum(spectrum.samples - dof, 1.0))
    # Relative to the largest, because an exact fit has variances of squared rounding errors.
    largest = max(float(noise.max(initial=0.0)), TINY)
    relative = noise / largest
    inner = gram(shares, relative) + np.diag(np.mean(relative**2) * ridge / damped**2)
    along = np.zeros((len(counts), int(counts.sum())))
    along[counts] = largest * np.linalg.cholesky(inner) / damped[:, None]
    return Posterior(along, noise, dof)
