"""Weighted least squares with standard errors; the weights follow from the residuals of each joint.

    theta minimises sum over joints of |Phi_j theta - tau_j|² / noise_j²

Directions that the data do not determine keep their prior values: of all theta that fit equally well, the solution is
the nearest to the prior, in units of the columns' lengths. The noise is noise_j² = |residual_j|² / (N - share of the
parameters that joint j determines); fit and noise alternate until the noise converges. The covariance of theta assumes
independent errors of this size. If residuals are correlated over T samples, T of them count as one
(`robust.residual_statistics`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.identification import equations
from dln_jax.identification.base import NEGLIGIBLE
from dln_jax.identification.equations import Equations
from dln_jax.types import InputError

ROUNDING = 1e-10
"""Singular values below this fraction of the largest are rounding errors of dependent columns."""
NOISE_FLOOR = 1e-10
"""Lower limit of a joint's noise, relative to the largest joint torque."""


class WeightedFit(NamedTuple):
    """Least-squares fit of P parameters to d joints."""

    theta: Float[np.ndarray, " P"]
    covariance: Float[np.ndarray, "P P"]
    """Includes every direction with an effect on the data, even those too weak to be used in the fit."""
    noise: Float[np.ndarray, " d"]
    """Standard deviation of the residual of each joint, N m or N."""
    rank: int
    """Number of combinations that the data determine."""
    condition: float
    """Largest over smallest singular value used, for columns of unit length."""
    unseen: Float[np.ndarray, "K P"]
    """Orthonormal directions along which theta keeps its prior value, in units of the columns' lengths."""
    without_effect: Float[np.ndarray, "M P"]
    """Those directions of `unseen` that have no effect on the data."""
    lengths: Float[np.ndarray, " P"]
    """Lengths of the columns in units of noise; zero for columns without effect."""

    def standard_errors(self, combinations: Float[np.ndarray, "B P"]) -> Float[np.ndarray, " B"]:
        """Standard errors of combinations of parameters; infinite if part of one has no effect on the data."""
        scaled = combinations / np.where(self.lengths > 0, self.lengths, 1.0)
        outside = np.linalg.norm(scaled @ self.without_effect.T, axis=1) > 1e-4 * np.linalg.norm(scaled, axis=1)
        variance = np.einsum("bp,pq,bq->b", combinations, self.covariance, combinations)
        return np.where(outside, np.inf, np.sqrt(np.maximum(variance, 0.0)))


def fit_weighted(
    given: Equations,
    known: Float[np.ndarray, " P"],
    *,
    noise: Float[np.ndarray, " d"] | None = None,
    correlation: Float[np.ndarray, " d"] | None = None,
    rank_tolerance: float | None = None,
    iterations: int = 20,
) -> WeightedFit:
    """Fits the parameters by weighted least squares.

    Args:
        given: equations of the data.
        known: prior values.
        noise: standard deviation of each joint's torque, N m or N; estimated by default, starting from equal noise.
        correlation: correlation time of each joint's residuals in samples; the covariance counts that many as one.
        rank_tolerance: singular values of unit-length columns, relative to the largest, that count as zero. Default:
            the inverse of the torque in units of its noise, at least 1e-10, since along such a direction even an effect
            as large as all torque would not rise above the noise.
        iterations: upper limit of the iterations for noise and parameters.

    Raises:
        InputError: noise is not positive, a tolerance is outside [0, 1), tau is zero, or there are fewer samples than
            parameters.
    """
    d, known = len(given.triangles), np.asarray(known, float)
    torque = np.sqrt(np.sum(given.triangles[:, :, -1] ** 2, axis=1) / given.samples)
    if not torque.any():
        raise InputError("tau is zero in every sample; identification takes measured torques")
    if noise is not None and not (np.shape(noise) == (d,) and np.all(np.asarray(noise) > 0)):
        raise InputError(f"noise is {noise}; expected a positive number for each of {d} joints")
    if rank_tolerance is not None and not 0 <= rank_tolerance < 1:
        raise InputError(f"rank_tolerance is {rank_tolerance}; expected a number in [0, 1)")
    if given.samples * d <= given.unknowns:
        raise InputError(f"{given.samples} samples of {d} joints for {given.unknowns} parameters; record more")
    shifted = equations.about(given, known)
    sigma = np.full(d, torque.mean()) if noise is None else np.asarray(noise, float)
    floor = NOISE_FLOOR * torque.max()
    for _ in range(iterations if noise is None else 0):
        fit, shares = _solved(shifted, sigma, None, ROUNDING)
        freedoms = np.maximum(given.samples - shares, 1.0)
        before, sigma = sigma, np.maximum(np.sqrt(equations.squares(shifted, fit.theta) / freedoms), floor)
        if (abs(sigma - before) <= 1e-6 * sigma).all():
            break
    if rank_tolerance is None:
        rank_tolerance = max(ROUNDING, 1 / np.sqrt(given.samples * np.sum((torque / sigma) ** 2)))
    fit, _ = _solved(shifted, sigma, correlation, rank_tolerance)
    return fit._replace(theta=known + fit.theta)


def _solved(
    given: Equations, sigma: np.ndarray, correlation: np.ndarray | None, rank_tolerance: float
) -> tuple[WeightedFit, np.ndarray]:
    """The fit for these noise levels, and every joint's share in determining the parameters; shares sum to the rank."""
    triangle = equations.weighted(given, sigma)
    A, b = triangle[:, :-1], triangle[:, -1]
    lengths = np.linalg.norm(A, axis=0)
    lengths = np.where(lengths > NEGLIGIBLE * lengths.max(initial=0.0), lengths, 0.0)
    scale = np.where(lengths > 0, lengths, 1.0)
    left, sizes, right = np.linalg.svd(np.where(lengths > 0, A, 0.0) / scale)
    rank, every = (int(np.sum(sizes > each * sizes[0])) for each in (rank_tolerance, min(ROUNDING, rank_tolerance)))
    to_theta = (right[:every] / sizes[:every, None]).T / scale[:, None]
    to_theta[lengths == 0] = 0.0  # large torques in units of small noise would amplify rounding here
    # Rows of each joint in the basis of directions with an effect: their squares sum to one over all joints.
    by_joint = [rows[:, :-1] @ to_theta / each for rows, each in zip(given.triangles, sigma, strict=True)]
    times = np.ones(len(sigma)) if correlation is None else np.asarray(correlation, float)
    middle = np.sum([time * rows.T @ rows for time, rows in zip(times, by_joint, strict=True)], axis=0)
    fit = WeightedFit(
        theta=to_theta[:, :rank] @ (left[:, :rank].T @ b),
        covariance=to_theta @ middle @ to_theta.T,
        noise=sigma,
        rank=rank,
        condition=float(sizes[0] / sizes[rank - 1]) if rank else np.inf,
        unseen=right[rank:],
        without_effect=right[every:],
        lengths=lengths,
    )
    return fit, np.array([np.sum(rows[:, :rank] ** 2) for rows in by_joint])
