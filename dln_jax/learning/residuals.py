"""What training makes small."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, vmap
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.types import InputError, Scalar, Vector


class Samples(NamedTuple):
    """The arrays that a torque residual reads, on the device, [N, d] each."""

    q: Array
    qd: Array
    qdd: Array
    tau: Array


def samples(data: Trajectories, dtype) -> Samples:
    """The samples of all trajectories as device arrays."""
    return Samples(*(jnp.asarray(array, dtype) for array in (data.q, data.qd, data.qdd, data.tau)))


def torque_scale(data: Trajectories) -> Float[Array, " d"]:
    """Standard deviation of each torque [d], in N m or N: the unit in which residuals are measured.

    A channel that does not vary (a joint without a motor) is measured in the root mean square of those that do.

    Raises:
        InputError: no channel varies, so that the data cannot tell any Lagrangian from its multiples.
    """
    deviation = data.tau.std(axis=0)
    # Rounding leaves a constant channel with a deviation of some 1e-17 of the torques it was computed from.
    varies = deviation > 1e-12 * abs(data.tau).max()
    if not varies.any():
        raise InputError(
            "tau is constant in every training sample: motion without varying torque fits any multiple of an energy; "
            "add trajectories that are driven by known, varying torques"
        )
    typical = (deviation[varies] ** 2).mean() ** 0.5
    return jnp.asarray([size if moves else typical for size, moves in zip(deviation, varies, strict=True)])


def torque_residual(dynamics: Dynamics, sample: Samples, scale: Vector) -> Vector:
    """(tau_hat - tau) / scale [d] of one sample."""
    return (dynamics.inverse_dynamics(sample.q, sample.qd, sample.qdd) - sample.tau) / scale


def torque_residuals(dynamics: Dynamics, batch: Samples, scale: Vector) -> Float[Array, "N d"]:
    """(tau_hat - tau) / scale of a batch."""
    return vmap(lambda *sample: torque_residual(dynamics, Samples(*sample), scale))(*batch)


def torque_loss(dynamics: Dynamics, batch: Samples, scale: Vector) -> Scalar:
    """Mean over samples of the sum of squared residuals over joints (Lutter et al. 2019)."""
    return jnp.mean(jnp.sum(torque_residuals(dynamics, batch, scale) ** 2, axis=-1))
