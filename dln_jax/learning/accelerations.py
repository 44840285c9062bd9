"""Accelerations of a model fitted to those of data, in coordinates and velocities, with or without torques.

    residual = (qdd_hat(q, qd, tau) - qdd) / spread of qdd

A first fit for `learning.measured_motions`, whose result does not rest on estimated accelerations; and all that is
needed where accelerations are exact.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data.magnitudes import on_device, spread
from dln_jax.data.schema import Trajectories
from dln_jax.learning.engine.problem import Problem, mean_square, unmonitored
from dln_jax.learning.measured_motions import Gauge, check_gauge, gauge_error
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, Scalar, require_positive

KEYS = ("q", "qd", "qdd", "tau")


def problem(
    model: Model,
    parameters: Parameters,
    data: Trajectories,
    validation: Trajectories,
    *,
    gauge: Gauge | None = None,
    most_samples: int = 4_000,
    seed: int = 0,
) -> Problem:
    """The fit of a model to accelerations, in float64.

    Args:
        model: of any energies, or of accelerations, with float64 parameters.
        parameters: to start from.
        data: to fit; of more than `most_samples` a subset is drawn by the seed.
        validation: to select by.
        gauge: what motions without torques need, and others do not.
        most_samples: fitted at most.
        seed: of the draw, and of the order of the samples.

    Raises:
        InputError: no gauge where there are no torques, or numbers that are too large.
    """
    require_positive(most_samples=most_samples)
    if gauge is None and not np.any(data.tau):
        raise InputError("motions without torques fit any multiple of an energy; give a gauge")
    check_gauge(gauge, data.degrees_of_freedom)
    size = spread("qdd", data.qdd)
    scale = jnp.asarray(np.where(size > 0, size, 1.0))

    def error(parameters: Parameters, q: Array, qd: Array, qdd: Array, tau: Array) -> Array:
        return (dynamics(model.energies(parameters)).forward_dynamics(q, qd, tau) - qdd) / scale

    def residual(parameters: Parameters, *sample: Array) -> Array:
        return jnp.append(error(parameters, *sample), gauge_error(dynamics(model.energies(parameters)), gauge))

    fitted, held_out = (
        tuple(on_device(key, getattr(each, key)[rows], jnp.float64) for key in KEYS)
        for each in (data, validation)
        for rows in [drawn(len(each.t), most_samples, seed)]
    )

    def score(parameters: Parameters) -> tuple[Scalar, Scalar]:
        return unmonitored(mean_square(lambda *sample: error(parameters, *sample), held_out))

    return Problem(residual, parameters, fitted, score, seed)


def drawn(samples: int, most: int, seed: int) -> np.ndarray:
    """Indices of `most` samples, or of all in order where there are no more."""
    if samples <= most:
        return np.arange(samples)
    return np.sort(np.random.default_rng(seed).choice(samples, size=most, replace=False))
