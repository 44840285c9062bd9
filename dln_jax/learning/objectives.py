"""Objectives of training: the arrays that they read, the scales of their residuals, and the residuals of a sample."""

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
    """Arrays [N, d] of `Trajectories` that the residual reads."""
    scale: Callable[[Trajectories], np.ndarray]
    """Training data -> the scales of the residuals. Raises InputError if the data cannot determine the model."""
    residual: Callable[..., Float[Array, " r"]]
    """(system, *sample) -> residuals of one sample, in SI units."""
    selects_by: str
    """"torque": validation is the mean square of the residual in (N m)², as published, to which large joints contribute
    most; "scaled": in units of the scales, so that all joints count alike."""

    @property
    def of_torques(self) -> bool:
        """Whether its residuals are torque errors and nothing else."""
        return self.residual is TORQUE.residual


def torque_scale(data: Trajectories) -> JointVector:
    """Standard deviations of the torques [d], in N m or N: the scales of the residuals.

    A channel that does not vary (a joint without a motor) is scaled by the root mean square of those that do.

    Raises:
        InputError: no torque varies, so any multiple of a Lagrangian fits; or squares are infinite or zero.
    """
    message = (
        "tau is constant in every training sample: motion without varying torque fits any multiple of an energy; "
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
    still = "is constant in every training sample: nothing moves, and no Hamiltonian can be told from another"
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
    still = "qdd is constant in every training sample; add trajectories that accelerate"
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
"""[tau_hat - tau, qdd_hat - qdd], in units of their standard deviations in the training samples: the loss of Lutter
and Peters (2021, arXiv:2110.01894). It also serves models whose inverse and forward sides are different networks."""

STATED = {"inverse": TORQUE, "forward": FORWARD, "both": BOTH_WAYS}
"""Objectives that a user may select by name."""


def objective_of(name: str, data: Trajectories, stated: str | None = None, *, torque: Objective = TORQUE) -> Objective:
    """Returns the objective of a model of the catalogue; a Hamiltonian needs momenta, and otherwise fits torques.

    Args:
        stated: name from `STATED` that overrides the model's own objective.
        torque: takes the place of `TORQUE`.

    Raises:
        InputError: only one side is selected for a model without an energy, whose other side would not be trained.
    """
    properties = CATALOGUE[name].properties
    if stated not in (None, "both") and not properties.energy:
        raise InputError(f"a {name} model has no energy, so both of its sides are trained; leave --objective out")
    own = CANONICAL if properties.canonical else TORQUE if properties.energy else BOTH_WAYS
    complete = all(getattr(data, key) is not None for key in own.keys)
    objective = STATED[stated] if stated is not None else own if complete else TORQUE
    return torque if objective is TORQUE else objective


def residuals(objective: Objective, system: System, batch: tuple[Array, ...]) -> Float[Array, "N r"]:
    """Residuals of a batch, in SI units."""
    return vmap(lambda *sample: objective.residual(system, *sample))(*batch)


def squared_torque_errors(model: Model, parameters: Parameters, data: Trajectories, scale: JointVector) -> JointSamples:
    """Squared torque error of every sample and joint, computed in float64, in units of the squared scale."""
    with jax.enable_x64(True):
        judge = jax.jit(lambda theta, batch: residuals(TORQUE, model.energies(theta), batch))
        errors = np.asarray(judge(parameters, arrays_of(data, TORQUE.keys)))
    return (errors / scale) ** 2


def _scale(name: str, array: np.ndarray, message: str) -> JointVector:
    """Standard deviations of the columns; a column that does not vary gets the root mean square of the others."""
    deviation = spread(name, array)
    # Rounding leaves a constant channel with a deviation of about 1e-17 of the numbers that it was computed from.
    varies = deviation > 1e-12 * abs(array).max()
    if not varies.any():
        raise InputError(message)
    typical = (deviation[varies] ** 2).mean() ** 0.5
    return np.where(varies, deviation, typical)
