"""Excitation task: the information that a motion gives on a model's parameters, and the robot's limits.

Phi is the derivative of the model's force in its parameters, restricted to independent columns ("base parameters").
Rows are weighted by the noise of their joint. The mean information of one sample is

    A = 1 / N sum over samples of Phiᵀ diag(1 / noise²) Phi,   so that least squares has the covariance A⁻¹ / N

Motions are finite Fourier series of one period, from rest to rest,

    q(t) = offset + sum over k = 1..H of s_k sin(k w t) + c_k cos(k w t),   w = 2 pi / period

after Swevers, Ganseman, Tukel, De Schutter and Van Brussel (1997, IEEE T-RA 13, "Optimal robot excitation and
identification"). Rates are exact, the spectrum is known, and a motion can be repeated indefinitely. Velocity and
acceleration vanish at both ends if sum k s_k = 0 and sum k² c_k = 0, whose solutions `rest_basis` spans.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int
from scipy.linalg import block_diag, qr

from dln_jax.identification.equations import NEGLIGIBLE
from dln_jax.identification.excitation.limits import Clearance, Excess, MotionLimits, beyond, require_limits
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters, linearised
from dln_jax.precision import compiled, require_double_precision
from dln_jax.solvers.least_squares import scaled_columns
from dln_jax.types import InputError, JointVector, require_positive, require_seed

MOST_HARMONICS = 50
"""Upper limit of harmonics for a design: more give no smooth motion and take hours."""
SAMPLES = 20
"""Samples per shortest period on the design grid."""
DEPENDENT = 1e-2
"""The design ignores columns whose residual after projection on the others is below this fraction of the largest:
right angles that a file writes as 1.57 leave 8e-4."""
STATES = 300
"""Number of random states for finding the independent columns."""


class FourierMotion(NamedTuple):
    """A periodic motion of d joints with H harmonics."""

    offset: Any
    """[d], mean posture, rad or m."""
    coefficients: Any
    """[d, 2 H]: s_1 .. s_H, c_1 .. c_H; rad or m."""
    period: float
    """s."""

    @property
    def harmonics(self) -> int:
        """H."""
        return np.shape(self.coefficients)[1] // 2


def sample(motion: FourierMotion, t: Any) -> tuple[Float[Array, "N d"], Float[Array, "N d"], Float[Array, "N d"]]:
    """q, qd and qdd at the times t [N], s."""
    functions = harmonic_functions(motion.harmonics, motion.period, t)
    return states(functions, motion.offset, motion.coefficients)


def states(functions: Any, offset: Any, coefficients: Any) -> tuple[Any, Any, Any]:
    """q, qd, qdd [N, d] of a series with these coefficients, from `harmonic_functions`."""
    q, qd, qdd = (values @ jnp.asarray(coefficients).T for values in functions)
    return offset + q, qd, qdd


def harmonic_functions(harmonics: int, period: float, t: Any) -> tuple[Array, Array, Array]:
    """sin(k w t) for k = 1..H, then cos(k w t), and their first and second derivatives; [N, 2 H] each."""
    rates = 2 * np.pi / period * np.arange(1, harmonics + 1)
    phases = rates * jnp.asarray(t)[:, None]
    sines, cosines = jnp.sin(phases), jnp.cos(phases)
    values = jnp.concatenate([sines, cosines], axis=1)
    slopes = jnp.concatenate([rates * cosines, -rates * sines], axis=1)
    return values, slopes, -(jnp.concatenate([rates, rates]) ** 2) * values


def rest_basis(harmonics: int) -> Float[np.ndarray, "F K"]:
    """Orthonormal columns [2 H, 2 H - 2] that span the coefficients of a joint at rest at both ends.

    Raises:
        InputError: fewer than two harmonics, which cannot move from rest to rest, or more than `MOST_HARMONICS`.
    """
    if not 2 <= harmonics <= MOST_HARMONICS:
        raise InputError(
            f"harmonics is {harmonics}; expected 2 to {MOST_HARMONICS}: with 1 a motion cannot start and end at rest"
        )
    orders = np.arange(1.0, harmonics + 1)
    # All but the first right singular vector of an equation are orthogonal to it.
    rests = (np.linalg.svd(equation[None, :])[2][1:].T for equation in (orders, orders**2))
    return np.asarray(block_diag(*rests))


def require_sampling(*, period: float, harmonics: int, rate: float) -> None:
    """Raises `InputError` unless the highest harmonic is below half the sampling rate (Hz)."""
    require_positive(seconds=period, harmonics=harmonics, rate=rate)
    highest = harmonics / period
    if highest >= rate / 2:
        raise InputError(
            f"{harmonics} harmonics of {period:g} s reach {highest:g} Hz, beyond half the sampling rate of {rate:g} "
            "Hz; take fewer harmonics, more seconds or a higher rate"
        )


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
    noise: JointVector
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
    bounded = np.isfinite(limits.force).all(axis=1)

    def observe(q: Array, qd: Array, qdd: Array) -> tuple[Array, Array, Excess]:
        Phi = regressor(q, qd, qdd)
        tau = Phi @ theta
        excess = Excess(
            position=beyond(limits.position, q),
            velocity=jnp.abs(qd) / limits.velocity - 1,
            acceleration=jnp.abs(qdd) / limits.acceleration - 1,
            force=beyond(limits.force[bounded], tau[bounded]) if bounded.any() else None,
            clearance=None if clearance is None else -clearance(q),
        )
        return Phi, tau, excess

    samples = compiled(jax.vmap(observe))
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
    scaled, _ = scaled_columns(A, NEGLIGIBLE)
    if not scaled.any():
        return np.zeros(0, int)
    factors: Any = qr(scaled, mode="r", pivoting=True)
    triangle, order = factors
    remainders = np.abs(np.diagonal(triangle))
    return np.sort(order[: len(remainders)][remainders > DEPENDENT * remainders[0]])
