"""Bayesian evidence for explanations of a log's torques, from predictions of left-out blocks.

An explanation is a Gaussian prior of all torques: a mean, and a sum of covariances weighted by variances. The weights
maximise the likelihood (minorisation-maximisation: Zhou et al., arXiv 1509.07426). Explanations are compared by the
probability of every block of time conditional on all others, so a fault counts only if it shows in most of the log.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

ITERATIONS = 12
"""Iterations of the likelihood maximisation; one digit of the weights is enough."""
BLOCKS = 10
WEIGHED = 300
"""Largest number of torques used to find the weights; predictions use all."""


class Prior(NamedTuple):
    """Gaussian prior of the torques of n samples [n d], sample by sample."""

    mean: Float[np.ndarray, " a"]
    parts: list[Float[np.ndarray, "a a"]]
    """Covariances, to be weighted."""
    columns: list[Float[np.ndarray, "a k"]]
    """Factors C of further covariances C Cᵀ, to be weighted; the last d are friction, joint by joint."""
    inertias: Callable[..., tuple[np.ndarray, list[np.ndarray], list[np.ndarray], int]]
    """(states q, qd and qdd [m, d], R [d, m d]) -> R times the inertial torques at these states: mean [d], and lists of
    covariances with the torques [d, n d] and with themselves [d, d], for the weights from a place on."""


class Explanation(NamedTuple):
    """How well a prior explains the torques."""

    weights: Float[np.ndarray, " w"]
    """Variance of every part, every factor, and every joint's noise."""
    inverse: Float[np.ndarray, "a a"]
    pull: Float[np.ndarray, " a"]
    """inverse (y - mean)."""
    densities: Float[np.ndarray, " B"]
    """Log probability of every block conditional on the others."""
    unexplained: Float[np.ndarray, "B d"]
    """Squared prediction error of every block, relative to the variance of the joint's torque."""


def explain(prior: Prior, tau: Float[np.ndarray, "n d"], *, iterations: int = ITERATIONS) -> Explanation:
    """Finds the maximum-likelihood weights and predicts every block from the others."""
    n, d = tau.shape
    few = np.arange(n * d).reshape(n, d)[:: -(-n * d // WEIGHED)].ravel()
    sizes = np.maximum(tau.var(axis=0), 1e-12 * tau.var(axis=0).max())
    y, noise = tau.ravel() - prior.mean, np.tile(sizes, n)
    square = np.ix_(few, few)
    some = prior._replace(
        mean=prior.mean[few],
        parts=[part[square] for part in prior.parts],
        columns=[columns[few] for columns in prior.columns],
    )
    weights = _likeliest(some, y[few], noise[few], d, iterations)
    inverse = _inverse(_covariance(prior, weights, noise, d))
    pull = inverse @ y
    densities, unexplained = [], []
    for block in blocks_of(n, d):
        own = inverse[np.ix_(block, block)]
        error = np.linalg.solve(own, pull[block])
        densities.append(0.5 * np.linalg.slogdet(own)[1] - 0.5 * error @ own @ error)
        unexplained.append(np.mean(error.reshape(-1, d) ** 2, axis=0) / np.maximum(tau.var(axis=0), 1e-300))
    return Explanation(weights, inverse, pull, np.array(densities), np.array(unexplained))


def _likeliest(prior: Prior, y: np.ndarray, noise: np.ndarray, d: int, iterations: int) -> np.ndarray:
    """Weights of parts, columns and noise [w]; the likelihood grows in every iteration."""
    traces = [np.mean(np.diag(part) / noise) for part in prior.parts]
    traces += [np.mean(np.sum(columns**2, axis=1) / noise) for columns in prior.columns]
    start = np.mean(y**2 / noise) / np.maximum(traces, 1e-300) / max(len(traces), 1)
    weights = np.concatenate([start, np.full(d, 0.05)])
    for _ in range(iterations):
        inverse = _inverse(_covariance(prior, weights, noise, d))
        pull = inverse @ y
        slopes = [(pull @ part @ pull, np.vdot(inverse, part)) for part in prior.parts]
        for columns in prior.columns:
            slopes.append((np.sum((columns.T @ pull) ** 2), np.vdot(columns, inverse @ columns)))
        own = (pull**2 * noise).reshape(-1, d), (np.diag(inverse) * noise).reshape(-1, d)
        slopes += zip(*(values.sum(axis=0) for values in own), strict=True)
        weights = weights * np.array([np.sqrt(fit / max(size, 1e-300)) for fit, size in slopes])
        weights[-d:] = np.maximum(weights[-d:], 1e-7)
    return weights


def _covariance(prior: Prior, weights: np.ndarray, noise: np.ndarray, d: int) -> np.ndarray:
    K = np.diag(np.tile(weights[-d:], len(noise) // d) * noise)
    for weight, part in zip(weights, prior.parts, strict=False):
        K += weight * part
    for weight, columns in zip(weights[len(prior.parts) :], prior.columns, strict=False):
        K += weight * columns @ columns.T
    # Rounding of large parts can make K indefinite if the noise is small, as on an exact log or a dead channel.
    K[np.diag_indices_from(K)] += len(K) * np.finfo(float).eps * K.diagonal().max()
    return K


def blocks_of(n: int, d: int) -> list[np.ndarray]:
    """Indices of the equations of every block of samples."""
    return [block.ravel() for block in np.array_split(np.arange(n * d).reshape(n, d), min(BLOCKS, n))]


def screened(now: Explanation, prior: Prior, trials: Sequence[Float[np.ndarray, "n d"]]) -> Float[np.ndarray, "B H"]:
    """Log density of every block for other torques at the same weights, relative to the first of them."""
    Y = np.stack([trial.ravel() for trial in trials], axis=1) - prior.mean[:, None]
    pull = now.inverse @ Y
    densities = []
    for block in blocks_of(*trials[0].shape):
        own = pull[block]
        densities.append(-0.5 * np.sum(own * np.linalg.solve(now.inverse[np.ix_(block, block)], own), axis=0))
    return np.array(densities) - np.array(densities)[:, :1]


def _inverse(K: np.ndarray) -> np.ndarray:
    from scipy.linalg.lapack import dpotrf, dpotri  # pyright: ignore[reportAttributeAccessIssue]

    factor, _ = dpotrf(K, lower=True)
    inverse, failed = dpotri(factor, lower=True)
    if failed:
        raise np.linalg.LinAlgError("the covariance of the torques is not positive definite")
    lower = np.tril(inverse)
    return lower + np.tril(inverse, -1).T
