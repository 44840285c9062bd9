"""Tests whether the torque residuals of a model show a missing force that depends on velocity.

Without friction tau(q, qd, qdd) = M qdd + c + g is even in time; friction is odd. The residual of a model without
friction, r = tau - tau_hat, is then b qd (viscous) and does work on average:

    P_j = qd_j r_j > 0,   b_j = sum(qd_j r_j) / sum(qd_j²),   share_j = b_j² sum(qd_j²) / sum(r_j²)

Residuals that are noise do no work: the mean of P over its standard error is then a standard normal variable.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.types import InputError

LEAST_SIGNIFICANCE = 5.0
"""The mean power is significant at this number of standard errors from zero."""
LEAST_SHARE = 0.01
"""Share of the residual's mean square that velocity must explain."""


class Misfit(NamedTuple):
    """Evidence for a missing force in the residuals of the joints [d]."""

    residual_rms: Float[np.ndarray, " d"]
    """In N m or N."""
    coefficient: Float[np.ndarray, " d"]
    """Viscous coefficient b that explains most of the residual; N m s or N s/m, negative for a driving force."""
    explained_share: Float[np.ndarray, " d"]
    """Share of the residual's mean square that b qd explains."""
    power: Float[np.ndarray, " d"]
    """Mean power qd r in W, which missing friction would dissipate."""
    significance: Float[np.ndarray, " d"]
    """Mean power in standard errors, over trajectories if there are ten or more, otherwise over samples."""
    missing: np.ndarray
    """Whether a velocity-dependent force is missing: significant, and more than a trace of the residual."""


def velocity_misfit(
    qd: Float[np.ndarray, "N d"],
    residual: Float[np.ndarray, "N d"],
    trajectory: np.ndarray | None = None,
) -> Misfit:
    """Looks for missing friction in the torque residuals tau - tau_hat [N, d] of a model.

    A missing potential also does work along motions that do not return. But velocity explains little of its residual,
    which `LEAST_SHARE` tests.

    Args:
        qd: velocities.
        residual: tau - tau_hat.
        trajectory: index of the samples' trajectories, whose samples count as one; `None` for independent samples.

    Raises:
        InputError: fewer than three samples, or shapes that differ.
    """
    qd, residual = np.asarray(qd, np.float64), np.asarray(residual, np.float64)
    if qd.shape != residual.shape or qd.ndim != 2 or len(qd) < 3:
        raise InputError(f"qd is {qd.shape} and residual {residual.shape}; expected the same [N, d] with N >= 3")
    power = qd * residual
    groups = np.arange(len(qd)) if trajectory is None else np.unique(trajectory, return_inverse=True)[1]
    if groups.max() < 9:
        groups = np.arange(len(qd))
    counts = np.bincount(groups)[:, None]
    means = np.stack([np.bincount(groups, column) for column in power.T], axis=1) / counts
    error = means.std(axis=0, ddof=1) / np.sqrt(len(means))
    moving, left = np.sum(qd**2, axis=0), np.sum(residual**2, axis=0)

    def ratio(above: np.ndarray, below: np.ndarray) -> np.ndarray:
        return np.divide(above, below, out=np.zeros(qd.shape[1]), where=below > 0)

    coefficient = ratio(power.sum(axis=0), moving)
    share, significance = ratio(coefficient**2 * moving, left), ratio(means.mean(axis=0), error)
    missing = (abs(significance) >= LEAST_SIGNIFICANCE) & (share >= LEAST_SHARE)
    return Misfit(np.sqrt(left / len(qd)), coefficient, share, power.mean(axis=0), significance, missing)
