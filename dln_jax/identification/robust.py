"""Residuals of identification: what they are like, and weights by which spikes among them count less."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.identification.equations import Regressor, compressed, residuals
from dln_jax.identification.weighted import WeightedFit, fit_weighted
from dln_jax.types import require_positive

THRESHOLD = 1.345
"""Of Huber (1964), in units of the noise: 95 % as efficient as least squares on normal errors."""
TO_DEVIATION = 1.4826
"""Standard deviation of normal errors over their median size."""


class ResidualStatistics(NamedTuple):
    """Of each joint's residuals [d]."""

    rms: Float[np.ndarray, " d"]
    """N m or N."""
    share_beyond_three: Float[np.ndarray, " d"]
    """Of samples with more than three times the noise; 0.0027 of normal ones."""
    excess_kurtosis: Float[np.ndarray, " d"]
    """0 of normal ones; large with spikes."""
    correlation: Float[np.ndarray, " d"]
    """Samples for which residuals follow each other, 1 where they are independent: 1 + 2 sum of autocorrelations."""


def residual_statistics(
    errors: Float[np.ndarray, "N d"], trajectory: np.ndarray, noise: Float[np.ndarray, " d"]
) -> ResidualStatistics:
    """Of residuals, their trajectories, and the noise that they are judged by."""
    square = np.mean(errors**2, axis=0)
    kurtosis = np.mean(errors**4, axis=0) / np.where(square > 0, square, 1.0) ** 2 - 3
    beyond = np.mean(abs(errors) > 3 * noise, axis=0)
    return ResidualStatistics(np.sqrt(square), beyond, kurtosis, correlation_times(errors, trajectory))


def correlation_times(errors: Float[np.ndarray, "N d"], trajectory: np.ndarray) -> Float[np.ndarray, " d"]:
    """1 + 2 sum of autocorrelations up to the first pair of lags without a positive sum (Geyer 1992)."""
    starts = np.flatnonzero(np.diff(trajectory)) + 1
    parts = np.split(errors, starts)
    longest = max(len(part) for part in parts)
    products = np.zeros((longest, errors.shape[1]))
    for part in parts:
        spectrum = abs(np.fft.rfft(part, 2 * len(part), axis=0)) ** 2
        products[: len(part)] += np.fft.irfft(spectrum, 2 * len(part), axis=0)[: len(part)]
    correlations = products / np.where(products[0] > 0, products[0], 1.0)
    times = np.ones(errors.shape[1])
    for joint, values in enumerate(correlations.T):
        pairs = values[: 2 * (longest // 2)].reshape(-1, 2).sum(axis=1)
        end = np.argmax(pairs <= 0) if (pairs <= 0).any() else len(pairs)
        times[joint] = max(2 * pairs[:end].sum() - 1, 1.0)
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
    """Huber's estimate: an error beyond `threshold` times the noise counts by its size and no longer by its square.

    Least squares again and again, with weights min(1, threshold noise / |error|), which are returned beside the fit;
    noise is the median size of errors.

    Args:
        regressor: the data's equations, of which each iteration takes one pass.
        known: values about which they are solved.
        threshold: in units of the noise.
        iterations: at most.
        tolerance: relative change of the predicted torques at which to stop.
        rank_tolerance: as for `fit_weighted`.

    Raises:
        InputError: a threshold that is not positive, or as `fit_weighted`.
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
