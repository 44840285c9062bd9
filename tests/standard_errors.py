"""By how much noise may part fitted parameters of measured motions from the truth."""

from typing import NamedTuple

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

SURE = 4.0
"""Number of standard errors that all of a few numbers stay within, except once in a thousand times."""


class Statistics(NamedTuple):
    """Statistics of a problem's residuals in units of their noise, at some parameters."""

    squares: float
    """Sum of the squares for measurements; noise alone gives `freedom`."""
    freedom: int
    """Measurements less unknowns: the starts of windows, and all that motions tell of P parameters."""
    slope: np.ndarray
    """J [N, P] of measurements, starts eliminated."""
    step: np.ndarray
    """To the least of the squares, to first order."""
    errors: np.ndarray
    """Standard errors of a converged fit, the roots of the diagonal of (JᵀJ)⁻¹, under the gauge if there is one."""


def statistics(task, parameters):
    """Returns the statistics of a problem of `learning.measured_motions` without measured velocities."""
    flat, unravel = ravel_pytree(parameters)

    def both(flat, *window):
        left = task.residual(unravel(flat), *window)
        return left, left

    rows = jax.jit(jax.vmap(jax.jacfwd(both, has_aux=True), in_axes=(None, *[0] * len(task.arrays))))
    slope, left = (np.asarray(each) for each in rows(flat, *task.arrays))
    _, q, _, _, weight = (np.asarray(each) for each in task.arrays)
    measured, size = q[0].size, np.sqrt(weight.sum(axis=1))
    r, J = size[:, None] * left[:, :measured], size[:, None, None] * slope[:, :measured]
    J, rest = J.reshape(-1, len(flat)), slope[:, measured:].reshape(-1, len(flat))
    every = np.concatenate([J, rest])
    inverse = np.linalg.inv(every.T @ every)
    step = -inverse @ every.T @ np.concatenate([r.ravel(), left[:, measured:].ravel()])
    unknowns = 2 * q.shape[2] * len(q) + np.linalg.matrix_rank(J)
    freedom = round(weight.sum()) * q.shape[2] - unknowns
    return Statistics(float(np.sum(r**2)), int(freedom), J, step, np.sqrt(np.diagonal(inverse)))
