"""Training objectives: their arrays, residuals, and the scales of the residuals."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, vmap
from jaxtyping import Float

from dln_jax.data.arrays import spread
from dln_jax.data.schema import Trajectories
from dln_jax.learning.engine.problem import arrays_of
from dln_jax.mechanics.equations import Energies, System, driving_force, dynamics, hamiltonian_of
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, JointSamples, JointVector, Vector
from dln_jax.zoo.catalogue import CATALOGUE


class Objective(NamedTuple):
    """Objective of a fit of dynamics."""

    keys: tuple[str, ...]
    """Arrays [N, d] of `Trajectories` in the residual."""
    scale: Callable[[Trajectories], np.ndarray]
    """Training data -> scales of the residuals; `InputError` if the data cannot determine the model."""
    residual: Callable[..., Float[Array, " r"]]
    """(system, *sample) -> residuals of one sample, in SI units."""
    selects_by: str
    """"torque": validate by the mean square of the residual in (N m)², as published; large joints dominate. "scaled":
    validate in units of the scales, so that all joints have equal weight."""

    @property
    def of_torques(self) -> bool:
        """Whether all residuals are torque errors."""
        return self.residual is TORQUE.residual


def torque_scale(data: Trajectories) -> JointVector:
    """Returns the standard deviations of the torques [d], N m or N, as scales of the residuals.

    A constant channel (a joint without a motor) takes the root mean square of the others.

    Raises:
        InputError: all torques are constant, so any multiple of a Lagrangian fits; or squares are infinite or zero.
    """
    message = (
        "tau is constant in all training samples, so any multiple of an energy fits; "
        "add trajectories that are driven by known, varying torques"
    )
    return _scale("tau", data.tau, message)


TORQUE = Objective(
    keys=("q", "qd", "qdd", "tau"),
    scale=torque_scale,
    residual=lambda system, q, qd, qdd, tau: dynamics(system).inverse_dynamics(q, qd, qdd) - tau,
    selects_by="torque",
)
"""tau_hat(q, qd, qdd) - tau, the published loss of DeLaN."""

SCALED_TORQUE = TORQUE._replace(selects_by="scaled")
"""The same residual; validation errors are in units of the joints' `torque_scale`."""


def _canonical_scale(data: Trajectories) -> np.ndarray:
    torque_scale(data)
    still = "is constant in all training samples: nothing moves, so the data do not determine a Hamiltonian"
    return np.concatenate([_scale(key, getattr(data, key), f"{key} {still}") for key in ("qd", "qdd")])


def _canonical_residual(system: Energies, q: Vector, qd: Vector, qdd: Vector, p: Vector, tau: Vector) -> Array:
    H = hamiltonian_of(system)
    pd = driving_force(system, q, qd, tau) - jax.grad(H)(q, p)
    velocity, acceleration = jax.jvp(jax.grad(H, argnums=1), (q, p), (qd, pd))
    return jnp.concatenate([velocity - qd, acceleration - qdd])


CANONICAL = Objective(
    keys=("q", "qd", "qdd", "p", "tau"), scale=_canonical_scale, residual=_canonical_residual, selects_by="scaled"
)
"""[dH/dp - qd, d/dt dH/dp - qdd] with dp/dt = tau - dH/dq - friction: Hamilton's equations in coordinates and momenta.

The published loss uses dp/dt of the data instead of qdd. In the published arm data dp/dt is a difference quotient of p
with a mean square error of 8e-6 (N m)², while q, qd, qdd and tau are consistent to rounding."""


def _both_scales(data: Trajectories) -> np.ndarray:
    still = "qdd is constant in all training samples; add trajectories with acceleration"
    return np.concatenate([torque_scale(data), _scale("qdd", data.qdd, still)])


FORWARD = SCALED_TORQUE._replace(
    scale=lambda data: _both_scales(data)[data.degrees_of_freedom :],
    residual=lambda system, q, qd, qdd, tau: dynamics(system).forward_dynamics(q, qd, tau) - qdd,
)
"""qdd_hat(q, qd, tau) - qdd."""

BOTH_WAYS = SCALED_TORQUE._replace(
    scale=_both_scales,
    residual=lambda *sample: jnp.concatenate([TORQUE.residual(*sample), FORWARD.residual(*sample)]),
)
"""[tau_hat - tau, qdd_hat - qdd] in units of their standard deviations in the training samples: the loss of Lutter and
Peters (2021, arXiv:2110.01894). It also suits models with separate inverse and forward networks."""

STATED = {"inverse": TORQUE, "forward": FORWARD, "both": BOTH_WAYS}
"""Objectives by name, for users."""


def objective_of(name: str, data: Trajectories, stated: str | None = None, *, torque: Objective = TORQUE) -> Objective:
    """Returns the objective of a catalogue model; a Hamiltonian without momenta in the data fits torques.

    Args:
        stated: name from `STATED` that overrides the model's own objective.
        torque: replaces `TORQUE`.

    Raises:
        InputError: a single side is selected for a model without an energy, which would leave the other side untrained.
    """
    properties = CATALOGUE[name].properties
    if stated not in (None, "both") and not properties.energy:
        raise InputError(
            f"a {name} model has no energy, so inverse and forward side both need training; leave --objective out"
        )
    own = CANONICAL if properties.canonical else TORQUE if properties.energy else BOTH_WAYS
    complete = all(getattr(data, key) is not None for key in own.keys)
    objective = STATED[stated] if stated is not None else own if complete else TORQUE
    return torque if objective is TORQUE else objective


def residuals(objective: Objective, system: System, batch: tuple[Array, ...]) -> Float[Array, "N r"]:
    """Returns the residuals of a batch, in SI units."""
    return vmap(lambda *sample: objective.residual(system, *sample))(*batch)


def squared_torque_errors(model: Model, parameters: Parameters, data: Trajectories, scale: JointVector) -> JointSamples:
    """Returns the squared torque error of each sample and joint in units of the squared scale, computed in float64."""
    with jax.enable_x64(True):
        judge = jax.jit(lambda theta, batch: residuals(TORQUE, model.energies(theta), batch))
        errors = np.asarray(judge(parameters, arrays_of(data, TORQUE.keys)))
    return (errors / scale) ** 2


def _scale(name: str, array: np.ndarray, message: str) -> JointVector:
    """Returns the standard deviations of the columns; a constant column takes the root mean square of the others."""
    deviation = spread(name, array)
    # Rounding leaves a constant channel with a deviation of about 1e-17 of its inputs.
    varies = deviation > 1e-12 * abs(array).max()
    if not varies.any():
        raise InputError(message)
    typical = (deviation[varies] ** 2).mean() ** 0.5
    return np.where(varies, deviation, typical)
