"""Predictions of one system, compiled for this system alone: its torques and motions, and their errors."""

import jax
import numpy as np
from jax.sharding import Mesh
from jax.typing import DTypeLike

from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.mechanics.equations import Driven
from dln_jax.metrics.errors import as_arrays, prediction_program, samples_of
from dln_jax.metrics.rollouts import metrics_of_motions, motion_program, records_of
from dln_jax.types import Hamiltonian


def predictions(
    system: Driven, data: Trajectories, dtype, *, H: Hamiltonian | None = None, mesh: Mesh | None = None
) -> dict[str, np.ndarray]:
    """Returns predictions of a system for every sample, in float64; arguments as for `prediction_program`."""
    program = jax.jit(prediction_program(lambda _: system, H=H, mesh=mesh))
    return as_arrays(program(None, samples_of(data, dtype)))


def rollout_metrics(
    dynamics: Dynamics | PlainDynamics, data: Trajectories, *, dtype: DTypeLike | None = None
) -> dict[str, float]:
    """Returns `metrics_of_motions` of a system's predictions from its first states and torques.

    Raises InputError for a trajectory of a single sample, or a coordinate that never changes.
    """
    motions, energies = jax.jit(motion_program(lambda _: dynamics))(None, records_of(data, dtype))
    return metrics_of_motions(motions, energies, data)
