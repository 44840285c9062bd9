"""Fits measured motions and the torques of the same samples in one objective.

    loss = mean over windows of |r_w|² + share * mean over samples of sum_j ((tau_hat_j - tau_j) / noise_j)²

r_w is that of `learning.measured_motions`, and tau_hat = tau_hat(q, qd, qdd) of filtered motions. Matched motions give
the parameters that predict best. If unmeasured forces act, the accelerations that they cause enter the torques of
filtered motions, and other parameters explain those best. The share sets the compromise.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import GAP, window_indices
from dln_jax.learning.engine.problem import Problem, arrays_of, mean_square, unmonitored
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, Scalar, require_positive


class TorqueWindows(NamedTuple):
    """Samples of W windows; shorter ones repeat their last sample with weight zero."""

    q: np.ndarray
    """[W, T, d], like qd, qdd and tau."""
    qd: np.ndarray
    qdd: np.ndarray
    tau: np.ndarray
    weight: np.ndarray
    """1 for a sample, 0 for a repeated one [W, T]."""


def cut_torque_windows(data: Trajectories, length: int, *, gap: float = GAP) -> TorqueWindows:
    """Cuts the same windows as `cut_measured_windows` on the same times, with the same arguments and errors."""
    indices, weight = window_indices(data, length, gap=gap)
    return TorqueWindows(data.q[indices], data.qd[indices], data.qdd[indices], data.tau[indices], weight)


def with_torques(
    task: Problem,
    model: Model,
    windows: TorqueWindows,
    validation: TorqueWindows,
    *,
    noise: tuple[float, ...],
    share: float,
) -> Problem:
    """Adds torques to the problem of measured motions; both together select the parameters on validation windows.

    Args:
        task: the problem from `measured_motions.problem`.
        model: the same model.
        windows: windows to fit, as many as there are motions.
        validation: windows that select the parameters.
        noise: standard deviations of the joints' torques [d], or the residuals of a fit of torques alone, N m or N.
        share: share of the torques in the loss.

    Raises:
        InputError: another number of windows, or a noise or share that is not positive.
    """
    require_positive(share=share, noise=min(noise))
    if (motions := len(task.arrays[0])) != len(windows.q):
        raise InputError(f"there are {len(windows.q)} windows of torques, {motions} of motions; cut both alike")
    held_out = arrays_of(validation)
    split = len(task.arrays)
    motion_residual = task.residual
    if motion_residual is None:
        raise InputError("the problem has no residual; give that of measured_motions.problem")

    def torque_error(parameters: Parameters, q: Array, qd: Array, qdd: Array, tau: Array, weight: Array) -> Array:
        off = jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics)(q, qd, qdd) - tau
        return jnp.ravel(jnp.sqrt(share * weight / jnp.sum(weight))[:, None] * off / jnp.asarray(noise))

    def residual(parameters: Parameters, *window: Array) -> Array:
        motion, torque = motion_residual(parameters, *window[:split]), torque_error(parameters, *window[split:])
        return jnp.concatenate([jnp.ravel(motion), torque])

    def score(parameters: Parameters) -> tuple[Scalar, Scalar]:
        torques = mean_square(lambda *window: torque_error(parameters, *window), held_out)
        return unmonitored(task.score(parameters)[0] + torques)

    return task._replace(residual=residual, arrays=(*task.arrays, *arrays_of(windows)), score=score)
