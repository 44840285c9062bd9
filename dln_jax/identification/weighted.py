"""Weighted and robust least squares with standard errors; the residuals of each joint give the weights.

    theta minimises sum over joints of |Phi_j theta - tau_j|² / noise_j²

Undetermined directions keep their prior values: among all theta that fit equally well, the solution is nearest to the
prior, in units of the columns' lengths. The noise is noise_j² = |residual_j|² / (N - share of the parameters that joint
j determines); fit and noise alternate until the noise converges. The covariance of theta assumes independent errors of
this size. If residuals are correlated over T samples, T samples count as one (`correlation_times`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.identification.equations import (
    NEGLIGIBLE,
    Equations,
    ParameterVector,
    Regressor,
    compress,
    residuals,
    squares,
    whiten,
)
from dln_jax.solvers.least_squares import scaled_columns
from dln_jax.types import InputError, JointSamples, JointVector

ROUNDING = 1e-10
"""Singular values below this fraction of the largest are rounding errors of dependent columns."""
NOISE_FLOOR = 1e-10
"""Lower limit of a joint's noise, relative to the largest joint torque."""
ROUNDS = 20
"""Largest number of alternations between noise and parameters."""
THRESHOLD = 1.345
"""Huber (1964), in units of the noise: 95 % as efficient as least squares for normal errors."""
TO_DEVIATION = 1.4826
"""Ratio of the standard deviation of normal errors to their median absolute value."""
REWEIGHTINGS, SETTLED = 30, 1e-4
"""Largest number of robust reweightings, and the smallest relative change of the residuals for another one."""


class WeightedFit(NamedTuple):
    """Least-squares fit of P parameters to d joints."""

    theta: ParameterVector
    covariance: Float[np.ndarray, "P P"]
    """Includes all directions with an effect on the data, even if too weak for the fit."""
    noise: JointVector
    """Standard deviation of the residual of each joint, N m or N."""
    rank: int
    """Number of combinations that the data determine."""
    condition: float
    """Ratio of the largest to the smallest singular value in the fit, for columns of unit length."""
    unseen: Float[np.ndarray, "K P"]
    """Orthonormal directions along which theta keeps its prior value, in units of the columns' lengths."""
    without_effect: Float[np.ndarray, "M P"]
    """Directions of `unseen` without effect on the data."""
    lengths: ParameterVector
    """Lengths of the columns in units of noise; zero for columns without effect."""

    def standard_errors(self, combinations: Float[np.ndarray, "B P"]) -> Float[np.ndarray, " B"]:
        """Returns standard errors of combinations of parameters; infinite if a part has no effect on the data."""
        scaled = combinations / np.where(self.lengths > 0, self.lengths, 1.0)
        undetermined = np.linalg.norm(scaled @ self.without_effect.T, axis=1) > 1e-4 * np.linalg.norm(scaled, axis=1)
        variance = np.einsum("bp,pq,bq->b", combinations, self.covariance, combinations)
        return np.where(undetermined, np.inf, np.sqrt(np.maximum(variance, 0.0)))


def fit_weighted(
    data: Equations,
    known: ParameterVector,
    *,
    noise: JointVector | None = None,
    correlation: JointVector | None = None,
) -> WeightedFit:
    """Fits the parameters by weighted least squares.

    Singular values of unit-length columns, relative to the largest, count as zero below 1e-10 or below the ratio of the
    noise to the torque. Along such a direction, an effect as large as the whole torque would not exceed the noise.

    Args:
        data: compressed equations.
        known: prior values.
        noise: standard deviation of each joint's torque noise, N m or N (default: estimated, starting from equal
            noise).
        correlation: correlation time of each joint's residuals in samples; that many samples count as one in the
            covariance.

    Raises:
        InputError: noise is not positive, tau is zero, or samples are too few.
    """
    d = len(data.triangles)
    torque = np.sqrt(np.sum(data.triangles[:, :, -1] ** 2, axis=1) / data.samples)
    if not torque.any():
        raise InputError("tau is zero in all samples; identification needs measured torques")
    if noise is not None and not (np.shape(noise) == (d,) and np.all(np.asarray(noise) > 0)):
        raise InputError(f"noise is {noise}; expected {d} positive numbers, one per joint")
    if data.samples * d <= len(known):
        raise InputError(f"{data.samples} samples of {d} joints are too few for {len(known)} parameters; record more")
    shifted = data._replace(triangles=data.triangles.copy())  # for theta - known as the unknown
    shifted.triangles[:, :, -1] -= data.triangles[:, :, :-1] @ known
    sigma = np.full(d, torque.mean()) if noise is None else np.asarray(noise, float)
    for _ in range(ROUNDS if noise is None else 0):
        fit, shares = _solve(shifted, sigma, None, ROUNDING)
        deviation = np.sqrt(squares(shifted, fit.theta) / np.maximum(data.samples - shares, 1.0))
        before, sigma = sigma, np.maximum(deviation, NOISE_FLOOR * torque.max())
        if (abs(sigma - before) <= 1e-6 * sigma).all():
            break
    rank_tolerance = max(ROUNDING, 1 / np.sqrt(data.samples * np.sum((torque / sigma) ** 2)))
    fit, _ = _solve(shifted, sigma, correlation, rank_tolerance)
    return fit._replace(theta=known + fit.theta)


def _solve(
    data: Equations, sigma: np.ndarray, correlation: np.ndarray | None, rank_tolerance: float
) -> tuple[WeightedFit, np.ndarray]:
    """Fits at these noise levels; also returns each joint's share of the determined parameters (the sum is the
    rank)."""
    triangle = whiten(data, sigma)
    scaled, lengths = scaled_columns(triangle[:, :-1], NEGLIGIBLE)
    effective = scaled.any(axis=0)
    left, sizes, right = np.linalg.svd(scaled)
    rank, effects = (int(np.sum(sizes > t * sizes[0])) for t in (rank_tolerance, ROUNDING))
    to_theta = (right[:effects] / sizes[:effects, None]).T / lengths[:, None]
    to_theta[~effective] = 0.0  # large torques in units of small noise would amplify rounding here
    # Rows of each joint in the basis of effective directions; their squares sum to one over all joints.
    by_joint = data.triangles[:, :, :-1] / sigma[:, None, None] @ to_theta
    times = np.ones(len(sigma)) if correlation is None else correlation
    middle = np.einsum("d,dki,dkj->ij", times, by_joint, by_joint)
    fit = WeightedFit(
        theta=to_theta[:, :rank] @ (left[:, :rank].T @ triangle[:, -1]),
        covariance=to_theta @ middle @ to_theta.T,
        noise=sigma,
        rank=rank,
        condition=float(sizes[0] / sizes[rank - 1]) if rank else np.inf,
        unseen=right[rank:],
        without_effect=right[effects:],
        lengths=np.where(effective, lengths, 0.0),
    )
    return fit, np.sum(by_joint[:, :, :rank] ** 2, axis=(1, 2))


def correlation_times(errors: JointSamples, trajectory: np.ndarray) -> JointVector:
    """Returns the correlation time of each joint's residuals in samples; 1 for independent residuals.

    The time is 1 + 2 sum of autocorrelations within trajectories, up to the first pair of lags with a sum that is not
    positive (Geyer 1992).
    """
    from scipy.signal import fftconvolve

    parts = np.split(errors, np.flatnonzero(np.diff(trajectory)) + 1)
    longest = max(len(part) for part in parts)
    products = np.zeros((longest, errors.shape[1]))
    for part in parts:
        products[: len(part)] += fftconvolve(part, part[::-1], axes=0)[len(part) - 1 :]
    correlations = products / np.where(products[0] > 0, products[0], 1.0)
    pairs = correlations[: 2 * (longest // 2)].reshape(-1, 2, errors.shape[1]).sum(axis=1)
    ended = np.logical_or.accumulate(pairs <= 0, axis=0)
    return np.maximum(2 * np.sum(np.where(ended, 0.0, pairs), axis=0) - 1, 1.0)  # the pairs include lag 0, which is 1


def fit_robust(regressor: Regressor, known: ParameterVector) -> tuple[WeightedFit, JointSamples]:
    """Fits with Huber's loss, which grows linearly instead of quadratically beyond `THRESHOLD` times the noise.

    Iteratively reweighted least squares with weights min(1, threshold noise / |error|), which are returned with the
    fit. The median absolute error gives the noise.

    Args:
        regressor: equations of the data; each iteration takes two passes.
        known: prior values.

    Raises:
        InputError: as for `fit_weighted`.
    """
    fit = fit_weighted(compress(regressor), known)
    errors = residuals(regressor, fit.theta)
    weights, tiny = np.ones_like(errors), np.finfo(float).tiny
    for _ in range(REWEIGHTINGS):
        noise = np.maximum(TO_DEVIATION * np.median(abs(errors), axis=0), tiny)
        weights = np.minimum(1.0, THRESHOLD * noise / np.maximum(abs(errors), tiny))
        fit = fit_weighted(compress(regressor, weights), known, noise=noise)
        before, errors = errors, residuals(regressor, fit.theta)
        if (np.linalg.norm(errors - before, axis=0) <= SETTLED * np.linalg.norm(errors, axis=0)).all():
            break
    return fit, weights
