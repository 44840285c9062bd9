"""Excitation task: the information that a motion gives on a model's parameters, and the robot's limits.

Phi is the derivative of the model's force in its parameters, restricted to independent columns ("base parameters").
Rows are weighted by the noise of their joint. The mean information of one sample is

    A = 1 / N sum over samples of Phiᵀ diag(1 / noise²) Phi,   so that least squares has the covariance A⁻¹ / N
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from dln_jax.identification.base import unit_columns
from dln_jax.identification.excitation.fourier import rest_basis
from dln_jax.identification.excitation.limits import Clearance, Excess, MotionLimits, excess, require_limits
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters, linearised
from dln_jax.precision import quick_compilation, require_double_precision
from dln_jax.types import InputError, require_positive, require_seed

SAMPLES = 20
"""Samples per shortest period on the design grid."""
DEPENDENT = 1e-2
"""The design ignores columns whose residual after projection on the others is below this fraction of the largest:
right angles that a file writes as 1.57 leave 8e-4."""
STATES = 300
"""Number of random states for finding the independent columns."""


class Task(NamedTuple):
    """A model to identify, and the constraints on the motions."""

    observe: Callable[..., tuple[Array, Array, Excess]]
    """(q, qd, qdd) -> Phi [d, P], tau [d] and the excess over the limits, for one state; differentiable."""
    samples: Callable[..., tuple[Array, Array, Excess]]
    """The same for `steps` states at once, compiled."""
    steps: int
    """N, samples of one period on the design grid."""
    columns: Int[np.ndarray, " B"]
    """Indices of the base parameters among all parameters of the model."""
    noise: Float[np.ndarray, " d"]
    limits: MotionLimits
    period: float
    """s."""
    harmonics: int


def make_task(
    model: Model,
    parameters: Parameters,
    limits: MotionLimits,
    *,
    period: float = 20.0,
    harmonics: int = 5,
    clearance: Clearance | None = None,
    noise: Any = 1.0,
    seed: int = 0,
) -> Task:
    """Makes a task for a model whose force is linear in its parameters, such as `models.trees.make_rigid_tree`.

    Smooth any friction that has a step at rest, on a scale of velocities that motions pass slowly.

    Args:
        parameters: nominal parameters, which give the forces to compare with their limits.
        period: period of the motions, s.
        harmonics: harmonics of the series, at least 2.
        clearance: q -> [K], m, that must stay positive.
        noise: standard deviation of the measured force of each joint [d], or one for all; only ratios matter.
        seed: seed of the random states that determine the base parameters.

    Raises:
        InputError: missing limits, a setting out of range, or no identifiable parameter.
    """
    require_double_precision("excitation")
    limits = MotionLimits(*(np.asarray(limit, float) for limit in limits))
    d = limits.velocity.size
    require_limits(limits, d)
    require_positive(period=period)
    require_seed(seed)
    rest_basis(harmonics)
    deviation = np.broadcast_to(np.asarray(noise, float), (d,))
    if not (deviation > 0).all():
        raise InputError(f"noise is {noise}; expected positive numbers, one for each of the {d} joints or for all")
    regressor, theta = linear_force(model, parameters)

    def observe(q: Array, qd: Array, qdd: Array) -> tuple[Array, Array, Excess]:
        Phi = regressor(q, qd, qdd)
        tau = Phi @ theta
        return Phi, tau, excess(limits, clearance, q, qd, qdd, tau)

    samples = jax.jit(jax.vmap(observe), compiler_options=quick_compilation())
    random, steps, seen = np.random.default_rng(seed), SAMPLES * harmonics, []
    for _ in range(-(-STATES // steps)):
        q = random.uniform(limits.position[:, 0], limits.position[:, 1], (steps, d))
        qd, qdd = (bound * random.uniform(-1, 1, (steps, d)) for bound in (limits.velocity, limits.acceleration))
        seen.append(np.asarray(samples(q, qd, qdd)[0]).reshape(steps * d, -1))
    columns = independent_columns(np.concatenate(seen))
    if not columns.size:
        raise InputError("no parameter of the model shows in its force; expected some that do")
    return Task(observe, samples, steps, columns, deviation, limits, float(period), harmonics)


def linear_force(model: Model, parameters: Parameters) -> tuple[Callable[..., Array], Float[np.ndarray, " P"]]:
    """(q, qd, qdd) -> Phi [d, P], and theta, with tau = Phi theta.

    The gradient of a function of Phi in the state equals that of d forces whose parameters are the function's gradients
    in the rows of Phi. This custom rule makes the program a third as large as derivatives of derivatives.
    """
    theta, unravel = ravel_pytree(parameters)

    def weighted_force(rows: Array, q: Array, qd: Array, qdd: Array) -> Array:
        def force(row: Array) -> Array:
            return dynamics(model.energies(unravel(row))).inverse_dynamics(q, qd, qdd)

        return jnp.trace(jax.vmap(force)(rows))

    @jax.custom_vjp
    def regressor(q: Array, qd: Array, qdd: Array) -> Array:
        return linearised(model, parameters, q, qd, qdd)[0]

    def forward(*state: Array) -> tuple[Array, tuple[Array, ...]]:
        return regressor(*state), state

    def backward(state: tuple[Array, ...], rows: Array) -> tuple[Array, ...]:
        return jax.grad(weighted_force, argnums=(1, 2, 3))(rows, *state)

    regressor.defvjp(forward, backward)
    return regressor, np.asarray(theta)


def independent_columns(A: Float[np.ndarray, "N P"]) -> Int[np.ndarray, " B"]:
    """Sorted indices of independent columns that span all others, by QR with pivoting of unit-length columns."""
    from scipy.linalg import qr

    scaled, lengths = unit_columns(A)
    if not lengths.any():
        return np.zeros(0, int)
    factors: Any = qr(scaled, mode="r", pivoting=True)
    triangle, order = factors[-2:]
    remainders = np.abs(np.diagonal(triangle))
    return np.sort(order[: len(remainders)][remainders > DEPENDENT * remainders[0]])
