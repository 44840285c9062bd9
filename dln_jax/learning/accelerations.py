"""Fits a model to measured accelerations, with or without torques.

    residual = (qdd_hat(q, qd, tau) - qdd) / spread of qdd

Use it as the first fit for `learning.measured_motions`, whose result does not depend on estimated accelerations. Where
accelerations are exact, this fit alone is enough.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data.arrays import spread
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select_samples
from dln_jax.learning.engine.problem import Problem, arrays_of, selected_by
from dln_jax.learning.measured_motions import Gauge, check_gauge, gauge_error
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.types import require_positive

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
    """Builds the problem of fitting a model to accelerations, in float64.

    Args:
        model: built from any energies, or from accelerations, with float64 parameters.
        data: training samples; if there are more than `most_samples`, a random subset is drawn.
        validation: samples that select the parameters.
        gauge: fixes the scale of the energies; needed only for motions without torques.
        seed: seed of the draw and of the order of the samples.

    Raises:
        InputError: the data have no torques and there is no gauge, or numbers are too large.
    """
    require_positive(most_samples=most_samples)
    check_gauge(gauge, data.tau, data.degrees_of_freedom)
    size = spread("qdd", data.qdd)
    scale = jnp.asarray(np.where(size > 0, size, 1.0))

    def error(parameters: Parameters, q: Array, qd: Array, qdd: Array, tau: Array) -> Array:
        return (dynamics(model.energies(parameters)).forward_dynamics(q, qd, tau) - qdd) / scale

    def residual(parameters: Parameters, *sample: Array) -> Array:
        return jnp.append(error(parameters, *sample), gauge_error(dynamics(model.energies(parameters)), gauge))

    fitted, held_out = (
        arrays_of(select_samples(part, drawn(len(part.t), most_samples, seed)), KEYS) for part in (data, validation)
    )
    return selected_by(held_out, residual, parameters, fitted, seed, error=error)


def drawn(samples: int, most: int, seed: int) -> np.ndarray:
    """Indices of `most` random samples in ascending order, or of all samples if there are no more than that."""
    if samples <= most:
        return np.arange(samples)
    return np.sort(np.random.default_rng(seed).choice(samples, size=most, replace=False))
