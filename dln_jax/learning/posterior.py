"""Posterior of a model's parameters from its training data: the covariance of a least-squares fit, and its noise.

The fit minimises sum over samples and joints of ((tau_hat_i - tau_i) / unit_i)² + ridge |D (theta - theta_0)|², to
first order about the fitted parameters. D holds the norms of the columns of the Jacobian J of the scaled residuals.
With J D⁻¹ = U S Vᵀ, torque noise of variance noise_i², and a prior of variance Sigma / ridge,

    Cov(D theta) = V (S² + ridge)⁻¹ (S Uᵀ Sigma U S + ridge Sigma) (S² + ridge)⁻¹ Vᵀ,   Sigma = diag(noise_i² / unit_i²)

For ridge = 0 this is the covariance of weighted least squares on the determined directions, for any weights. If all
joints have the same Sigma it is Laplace's approximation, Sigma (JᵀJ + ridge D²)⁻¹. The degrees of freedom of joint i
are the trace of the hat matrix over its rows:  noise_i² = sum r_i² / (N - dof_i).
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Rows = Iterator[tuple[np.ndarray, np.ndarray]]
"""Phi [n, d, P] and tau_hat - tau [n, d], some samples at a time."""
ALONE = 1e-6
"""Some samples alone determine a direction if the others hold less than this share of the information on it."""


class Spectrum(NamedTuple):
    """Singular value decomposition of J D⁻¹, and its factors by joint."""

    scale: Float[np.ndarray, " P"]
    """D."""
    sizes: Float[np.ndarray, " P"]
    """S, zero for undetermined directions."""
    directions: Float[np.ndarray, "P P"]
    """V, in columns."""
    triangles: list[np.ndarray]
    """J_i D⁻¹ V of every joint, up to a rotation of its rows, [.., P]."""
    squares: Float[np.ndarray, " d"]
    """Sums of squared residuals of the joints, (N m)² or N²."""
    unit: Float[np.ndarray, " d"]
    """Scales of the fitted residuals, N m or N."""
    samples: int


class Posterior(NamedTuple):
    """Covariance of the parameters, noise, and the number of parameters that the data determine."""

    along: Float[np.ndarray, "K r"]
    """Factor of the covariance of D theta along the directions of the spectrum."""
    noise: Float[np.ndarray, " d"]
    """Standard deviations, N m or N."""
    degrees_of_freedom: Float[np.ndarray, " d"]


def spectrum(rows: Rows, unit: Float[np.ndarray, " d"], *, negligible: float = 0.0) -> Spectrum:
    """Computes the spectrum of all rows; takes about N d P² operations, and memory for d P² numbers.

    Args:
        rows: columns and residuals of the training data.
        unit: scales of the joints' residuals in the fit.
        negligible: as for `solvers.least_squares.solve`.
    """
    triangles: list[np.ndarray] = []
    samples = 0
    for columns, residual in rows:
        samples += len(residual)
        both = np.concatenate([columns, residual[:, :, None]], axis=2)
        parts = [np.concatenate([*triangles[joint : joint + 1], both[:, joint]]) for joint in range(len(unit))]
        triangles = [np.linalg.qr(part, mode="r") for part in parts]  # factors of the joints' [Phi_i r_i]
    squares = np.array([np.sum(triangle[:, -1] ** 2) for triangle in triangles])
    weighted = [triangle[:, :-1] / size for triangle, size in zip(triangles, unit, strict=True)]
    P = weighted[0].shape[1]
    norms = np.sqrt(sum(np.sum(triangle**2, axis=0) for triangle in weighted))
    seen = norms > negligible * norms.max(initial=0.0)
    scale = np.where(seen, norms, 1.0)
    scaled = [np.where(seen, triangle, 0.0) / scale for triangle in weighted]
    _, sizes, right = np.linalg.svd(np.linalg.qr(np.concatenate(scaled), mode="r"), full_matrices=True)
    sizes = np.concatenate([sizes, np.zeros(P - len(sizes))])
    tolerance = np.finfo(np.float64).eps * max(samples * len(unit), P)
    sizes = np.where(sizes > tolerance * sizes.max(initial=0.0), sizes, 0.0)
    return Spectrum(scale, sizes, right.T, [triangle @ right.T for triangle in scaled], squares, unit, samples)


def leave_out(
    spectrum: Spectrum,
    noise: Float[np.ndarray, " d"],
    columns: Float[np.ndarray, "n d P"],
    residual: Float[np.ndarray, "n d"],
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
    """Returns the residuals of training samples as if they had not been fitted, and their variance due to parameters.

    With U their rows of the orthonormal factor of J, r~ = r + U (1 - UᵀU)⁻¹ Uᵀ r: exact for least squares without a
    ridge (Cook and Weisberg 1982, "Residuals and influence in regression", section 2.2, for groups of samples).

    Args:
        noise: standard deviations from `posterior`.
        columns: Phi D⁻¹ V of the samples.
        residual: tau_hat - tau of the samples.
    """
    counts, unit = spectrum.sizes > 0, spectrum.unit
    along = columns[:, :, counts] / spectrum.sizes[counts]
    relative = (noise / unit) ** 2
    U = along / unit[:, None]
    values, vectors = np.linalg.eigh(np.eye(U.shape[2]) - np.einsum("nip,niq->pq", U, U, optimize=True))
    # A direction that only these samples determine is fitted exactly: its residual is zero and carries no information.
    inverse = (vectors * np.divide(1, values, out=np.zeros_like(values), where=values > ALONE)) @ vectors.T
    inner = -np.einsum("nip,i,niq->pq", U, relative, U, optimize=True)
    for size, triangle in zip(relative, spectrum.triangles, strict=True):
        share = triangle[:, counts] / spectrum.sizes[counts]
        inner += size * (share.T @ share)
    weighted = residual / unit
    predicted = U @ (inverse @ np.einsum("nip,ni->p", U, weighted))
    variance = np.einsum("nip,pq,niq->ni", along, inverse @ inner @ inverse, along, optimize=True)
    return (weighted + predicted) * unit, np.maximum(variance, 0.0)


def leading_directions(rows: Callable[[], Rows], unit: Float[np.ndarray, " d"], count: int) -> Float[np.ndarray, "P K"]:
    """Returns the combinations of parameters that the data determine best, for models too large for a full spectrum.

    Subspace iteration on D⁻¹JᵀJ D⁻¹ (Halko, Martinsson and Tropp 2011, algorithm 4.4). Phi times the result is the
    Jacobian of a model whose parameters vary only in that subspace (Izmailov et al. 2020, "Subspace inference").

    Args:
        rows: iterates over the training data anew at every call.
        unit: scales of the joints' residuals in the fit.
        count: K.
    """
    squares = sum(np.sum((columns / unit[:, None]) ** 2, axis=(0, 1)) for columns, _ in rows())
    scale = np.sqrt(np.where(squares > 0, squares, 1.0))
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(len(scale), count)))[0]
    for _ in range(2):
        products = np.zeros_like(basis)
        for columns, _residual in rows():
            scaled = (columns / unit[:, None] / scale).reshape(-1, len(scale))
            products += scaled.T @ (scaled @ basis)
        basis = np.linalg.qr(products)[0]
    return basis / scale[:, None]


def posterior(spectrum: Spectrum, ridge: float) -> Posterior:
    """Returns the posterior for a ridge; with 0, undetermined directions have no variance."""
    counts = (spectrum.sizes > 0) | (ridge > 0)
    damped = np.sqrt(spectrum.sizes[counts] ** 2 + ridge)
    shares = [triangle[:, counts] / damped for triangle in spectrum.triangles]
    dof = np.array([np.sum(share**2) for share in shares])
    noise = np.sqrt(spectrum.squares / np.maximum(spectrum.samples - dof, 1.0))
    relative = (noise / spectrum.unit) ** 2
    inner = np.diag(relative.mean() * ridge / damped**2)
    for size, share in zip(relative, shares, strict=True):
        inner += size * (share.T @ share)
    along = np.zeros((len(counts), int(counts.sum())))
    # Scaled by the largest, because the variances of an exact fit are squares of rounding errors.
    largest = max(float(relative.max(initial=0.0)), np.finfo(np.float64).tiny)
    along[counts] = np.sqrt(largest) * np.linalg.cholesky(inner / largest) / damped[:, None]
    return Posterior(along, noise, dof)
