"""Least squares in which each joint counts by its noise, which its own residuals tell, with standard errors.

    theta minimises sum over joints of |Phi_j theta - tau_j|² / noise_j²

about values that are known before, so that what data do not show stays as it was: of all theta that fit equally well
it is the nearest, in units of the columns' lengths. Then noise_j² = |residual_j|² / (N - share of the parameters that
joint j determines), and again, until noises stay. The covariance of theta is that of independent errors of this size;
where residuals follow each other for T samples, T of them count as one (`robust.residual_statistics`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.identification import equations
from dln_jax.identification.base import NEGLIGIBLE
from dln_jax.identification.equations import Equations
from dln_jax.types import InputError

ROUNDING = 1e-10
"""Relative singular values below it are rounding of dependent columns."""
NOISE_FLOOR = 1e-10
"""Least noise of a joint, relative to the torque of all, that weights may tell from none."""


class WeightedFit(NamedTuple):
    """What least squares find, of P parameters and d joints."""

    theta: Float[np.ndarray, " P"]
    covariance: Float[np.ndarray, "P P"]
    """Of all that has an effect on the data, also where it is too small to be used."""
    noise: Float[np.ndarray, " d"]
    """Standard deviation of each joint's residual, N m or N."""
    rank: int
    """Combinations that the data determine."""
    condition: float
    """Largest over smallest singular value that counts, of columns of one length."""
    unseen: Float[np.ndarray, "K P"]
    """Orthonormal directions along which theta stays as it was, in units of the columns' lengths."""
    without_effect: Float[np.ndarray, "M P"]
    """Those of them that change nothing in the data."""
    lengths: Float[np.ndarray, " P"]
    """Of the columns, in units of noise; zero where there is none."""

    def standard_errors(self, combinations: Float[np.ndarray, "B P"]) -> Float[np.ndarray, " B"]:
        """Of combinations of parameters; infinite where one has a part without effect on the data."""
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
    """The weighted least-squares fit.

    Args:
        given: the data's equations.
        known: values about which they are solved.
        noise: standard deviation of each joint's torque, N m or N; by default estimated, all joints alike at first.
        correlation: samples for which residuals of a joint follow each other, which the covariance counts as one.
        rank_tolerance: singular values of columns of one length, relative to the largest, that count as zero; by
            default the inverse of the torque in units of its noise, at least 1e-10. A combination with an effect of the
            size of all torque along such a direction would not rise above the noise.
        iterations: of noise and parameters, at most.

    Raises:
        InputError: noise that is not positive, a tolerance outside [0, 1), no torque, or fewer samples than parameters.
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
    """The fit with these noises, and of the parameters the share that each joint determines, which sum to the rank."""
    triangle = equations.weighted(given, sigma)
    A, b = triangle[:, :-1], triangle[:, -1]
    lengths = np.linalg.norm(A, axis=0)
    lengths = np.where(lengths > NEGLIGIBLE * lengths.max(initial=0.0), lengths, 0.0)
    scale = np.where(lengths > 0, lengths, 1.0)
    left, sizes, right = np.linalg.svd(np.where(lengths > 0, A, 0.0) / scale)
    rank, every = (int(np.sum(sizes > each * sizes[0])) for each in (rank_tolerance, min(ROUNDING, rank_tolerance)))
    to_theta = (right[:every] / sizes[:every, None]).T / scale[:, None]
    to_theta[lengths == 0] = 0.0  # and not rounding, which large torques in units of small noise would show
    # Rows of each joint in the basis of what has an effect: their squares sum to one over all joints.
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
