"""Excitation task: the information in a motion about a model's parameters, and the robot's limits.

Phi is the derivative of the model's force with respect to its parameters, restricted to independent columns ("base
parameters"). The noise of each joint weights its row. The mean information of one sample is

    A = 1 / N sum over samples of Phiᵀ diag(1 / noise²) Phi,   so that least squares has the covariance A⁻¹ / N

Motions are finite Fourier series of one period, from rest to rest,

    q(t) = offset + sum over k = 1..H of s_k sin(k w t) + c_k cos(k w t),   w = 2 pi / period

after Swevers, Ganseman, Tukel, De Schutter and Van Brussel (1997, IEEE T-RA 13, "Optimal robot excitation and
identification"). Rates are exact, the spectrum is known, and a motion can be repeated indefinitely. Velocity and
acceleration vanish at both ends if sum k s_k = 0 and sum k² c_k = 0; `rest_basis` spans the solutions.
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
"""Largest number of harmonics in a design; more take hours and make rough motions."""
SAMPLES = 20
"""Samples per shortest period on the design grid."""
DEPENDENT = 1e-2
"""The design ignores columns with a residual, after projection on the others, below this fraction of the largest: a
right angle written as 1.57 leaves 8e-4."""
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
    """Returns q, qd and qdd at the times t [N], s."""
    functions = harmonic_functions(motion.harmonics, motion.period, t)
    return states(functions, motion.offset, motion.coefficients)


def states(functions: Any, offset: Any, coefficients: Any) -> tuple[Any, Any, Any]:
    """Returns q, qd, qdd [N, d] of a series with these coefficients; functions from `harmonic_functions`."""
    q, qd, qdd = (values @ jnp.asarray(coefficients).T for values in functions)
    return offset + q, qd, qdd


def harmonic_functions(harmonics: int, period: float, t: Any) -> tuple[Array, Array, Array]:
    """Returns sin(k w t) for k = 1..H, then cos(k w t), and their first and second derivatives; [N, 2 H] each."""
    rates = 2 * np.pi / period * np.arange(1, harmonics + 1)
    phases = rates * jnp.asarray(t)[:, None]
    sines, cosines = jnp.sin(phases), jnp.cos(phases)
    values = jnp.concatenate([sines, cosines], axis=1)
    slopes = jnp.concatenate([rates * cosines, -rates * sines], axis=1)
    return values, slopes, -(jnp.concatenate([rates, rates]) ** 2) * values


def rest_basis(harmonics: int) -> Float[np.ndarray, "F K"]:
    """Returns orthonormal columns [2 H, 2 H - 2] that span the coefficients of a joint at rest at both ends.

    Raises:
        InputError: more than `MOST_HARMONICS`, or fewer than two, which cannot move from rest to rest.
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
            f"{harmonics} harmonics of {period:g} s reach {highest:g} Hz, above half the sampling rate of {rate:g} "
            "Hz; use fewer harmonics, more seconds or a higher rate"
        )


class Task(NamedTuple):
    """A model to identify, and the constraints on the motions."""

    observe: Callable[..., tuple[Array, Array, Excess]]
    """(q, qd, qdd) -> Phi [d, P], tau [d] and the excess over the limits, for one state; differentiable."""
    samples: Callable[..., tuple[Array, Array, Excess]]
    """The compiled `observe` for `steps` states at once."""
    steps: int
    """N, samples of one period on the design grid."""
    columns: Int[np.ndarray, " B"]
    """Indices of the base parameters among the model's parameters."""
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
    """Makes a task for a model that is linear in its parameters, such as `models.trees.make_rigid_tree`.

    Smooth any friction with a step at rest, on a velocity scale that motions pass slowly.

    Args:
        model: the model to identify.
        parameters: nominal parameters, which predict the forces for the force limits.
        limits: limits of the robot.
        period: period of the motions, s.
        harmonics: harmonics of the series, at least 2.
        clearance: q -> clearances [K], m, that must stay positive.
        noise: standard deviation of the measured force of each joint [d], or one number; only ratios matter.
        seed: seed for the random states that determine the base parameters.

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
        raise InputError(f"noise is {noise}; expected one positive number, or {d}, one per joint")
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
        raise InputError("the model's force does not depend on its parameters; check the model")
    return Task(observe, samples, steps, columns, deviation, limits, float(period), harmonics)


def linear_force(model: Model, parameters: Parameters) -> tuple[Callable[..., Array], Float[np.ndarray, " P"]]:
    """Returns (q, qd, qdd) -> Phi [d, P], and theta, with tau = Phi theta.

    The gradient of a function of Phi with respect to the state is the gradient of d forces, with the function's
    gradients with respect to the rows of Phi as parameters. This custom rule makes the program a third as large as
    nested derivatives.
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
    """Returns sorted indices of independent columns that span all others, by pivoted QR of unit-length columns."""
    scaled, _ = scaled_columns(A, NEGLIGIBLE)
    if not scaled.any():
        return np.zeros(0, int)
    factors: Any = qr(scaled, mode="r", pivoting=True)
    triangle, order = factors
    remainders = np.abs(np.diagonal(triangle))
    return np.sort(order[: len(remainders)][remainders > DEPENDENT * remainders[0]])
