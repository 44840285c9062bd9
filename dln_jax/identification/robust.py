"""Residual statistics of an identification, and weights that reduce the influence of outliers."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.identification.equations import Regressor, compressed, residuals
from dln_jax.identification.weighted import WeightedFit, fit_weighted
from dln_jax.types import require_positive

THRESHOLD = 1.345
"""Huber (1964), in units of the noise: 95 % as efficient as least squares for normal errors."""
TO_DEVIATION = 1.4826
"""Ratio of the standard deviation of normal errors to their median absolute value."""


class ResidualStatistics(NamedTuple):
    """Statistics of the residuals of each joint [d]."""

    rms: Float[np.ndarray, " d"]
    """Root mean square, N m or N."""
    share_beyond_three: Float[np.ndarray, " d"]
    """Fraction of samples beyond three times the noise; 0.0027 for normal errors."""
    excess_kurtosis: Float[np.ndarray, " d"]
    """0 for normal errors; large for outliers."""
    correlation: Float[np.ndarray, " d"]
    """Correlation time in samples, 1 + 2 sum of autocorrelations; 1 for independent residuals."""


def residual_statistics(
    errors: Float[np.ndarray, "N d"], trajectory: np.ndarray, noise: Float[np.ndarray, " d"]
) -> ResidualStatistics:
    """Statistics of residuals relative to a noise level; they are correlated within trajectories only."""
    square = np.mean(errors**2, axis=0)
    kurtosis = np.mean(errors**4, axis=0) / np.where(square > 0, square, 1.0) ** 2 - 3
    beyond = np.mean(abs(errors) > 3 * noise, axis=0)
    return ResidualStatistics(np.sqrt(square), beyond, kurtosis, correlation_times(errors, trajectory))


def correlation_times(errors: Float[np.ndarray, "N d"], trajectory: np.ndarray) -> Float[np.ndarray, " d"]:
    """1 + 2 sum of autocorrelations, truncated at the first pair of lags whose sum is not positive (Geyer 1992)."""
    starts = np.flatnonzero(np.diff(trajectory)) + 1
    parts = np.split(errors, starts)
    longest = max(len(part) for part in parts)
    products = np.zeros((longest, errors.shape[1]))
    for part in parts:
        # Zero padding to twice the length keeps the correlation from wrapping round.
        spectrum = abs(np.fft.rfft(part, 2 * len(part), axis=0)) ** 2
        products[: len(part)] += np.fft.irfft(spectrum, 2 * len(part), axis=0)[: len(part)]
    correlations = products / np.where(products[0] > 0, products[0], 1.0)
    times = np.ones(errors.shape[1])
    for joint, values in enumerate(correlations.T):
        pairs = values[: 2 * (longest // 2)].reshape(-1, 2).sum(axis=1)
        end = np.argmax(pairs <= 0) if (pairs <= 0).any() else len(pairs)
        times[joint] = max(2 * pairs[:end].sum() - 1, 1.0)  # the pairs include lag 0, which is 1
    return times


def fit_robust(
    regressor: Regressor,
    known: Float[np.ndarray, " P"],
    *,
    threshold: float = THRESHOLD,
    iterations: int = 30,
    tolerance: float = 1e-4,
    rank_tolerance: float | None = None,
) -> tuple[WeightedFit, Float[np.ndarray, "N d"]]:
    """Huber's estimate: the loss grows linearly instead of quadratically beyond `threshold` times the noise.

    Iteratively reweighted least squares with weights min(1, threshold noise / |error|), returned with the fit; the
    noise is estimated from the median absolute error.

    Args:
        regressor: equations of the data; every iteration takes two passes.
        known: prior values.
        threshold: in units of the noise.
        iterations: upper limit.
        tolerance: relative change of the residuals at which to stop.
        rank_tolerance: as for `fit_weighted`.

    Raises:
        InputError: the threshold is not positive, or as `fit_weighted`.
    """
    require_positive(threshold=threshold)
    fit = fit_weighted(compressed(regressor), known, rank_tolerance=rank_tolerance)
    errors = residuals(regressor, fit.theta)
    weights = np.ones_like(errors)
    for _ in range(iterations):
        deviation = TO_DEVIATION * np.median(abs(errors), axis=0)
        noise = np.maximum(deviation, np.finfo(float).tiny)
        weights = np.minimum(1.0, threshold * noise / np.maximum(abs(errors), np.finfo(float).tiny))
        fit = fit_weighted(compressed(regressor, weights), known, noise=noise, rank_tolerance=rank_tolerance)
        before, errors = errors, residuals(regressor, fit.theta)
        if (np.linalg.norm(errors - before, axis=0) <= tolerance * np.linalg.norm(errors, axis=0)).all():
            break
    return fit, weights
