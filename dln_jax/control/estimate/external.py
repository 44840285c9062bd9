"""External torques by a momentum observer, contacts at a stated rate of false alarms, and the wrench at a flange.

With the momentum p = M(q) qd and the Lagrangian L = T - V, the equations of motion read

    dp/dt = tau + dL/dq - friction + external,      r' = gain (external - r)

so the residual r follows the external torque like a first-order low-pass, without accelerations and without an inverse
mass matrix (De Luca and Mattone 2003; De Luca, Albu-Schäffer, Haddadin and Hirzinger 2006). In sampled time, with tau
held and the trapezoidal rule for beta = dL/dq - friction,

    r <- r + (1 - exp(-gain dt)) ((p' - p) / dt - tau - (beta + beta') / 2 - r)

A push shows when r leaves the band of the model's own errors. The score of a sample is the largest |r_i| / band_i, with
the standard deviation band_i of r without contact: the model's torque band, for example `Run.torque_std` at this state,
or the root mean square of r in motions without contact. `contact_threshold` finds the score that motions without
contact exceed only as often as allowed.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.solvers.elimination import symmetric_eigen
from dln_jax.types import InputError, Scalar, Vector, require_positive

BLOCK = 1.0
"""Length of the blocks whose largest scores are fitted, s."""
LEAST_BLOCKS = 20
"""Fewest blocks for a fit."""


Observer = tuple[Any, Callable[[Any, Vector, Vector, Vector], tuple[Any, Array]]]
"""First memory, and (memory, q, qd, tau held since the previous sample) -> (memory, r at this sample); pure."""


def momentum_observer(model: Dynamics | InverseForward, d: int, *, rate: float, gain: Any) -> Observer:
    """Returns a momentum observer of a natural system.

    Args:
        model: known or learned, with an energy; its friction counts as known.
        d: number of coordinates.
        rate: sampling rate, Hz.
        gain: gain of the residual, 1/s, one for all or one per joint; 1 / gain is the time constant.

    Raises:
        InputError: the model has no energy, or a number is not positive.
    """
    if not isinstance(model, Dynamics):
        raise InputError("the model has no energy, which a momentum observer needs; train a DeLaN, for example")
    require_positive(d=d, rate=rate)
    for number in np.ravel(gain):
        require_positive(gain=float(number))
    share = -jnp.expm1(-jnp.asarray(gain, float) / rate)

    def lagrangian(q: Vector, qd: Vector) -> Scalar:
        return model.energy(q, qd) - 2 * model.energy(q, jnp.zeros_like(qd))

    def update(memory: tuple, q: Vector, qd: Vector, tau: Vector) -> tuple[tuple, Array]:
        r, p_before, beta_before, begun = memory
        p = model.mass_matrix(q) @ qd
        beta = jax.grad(lagrangian)(q, qd) - model.friction(q, qd)
        external = (p - p_before) * rate - tau - (beta + beta_before) / 2
        r = jnp.where(begun, r + share * (external - r), r)
        return (r, p, beta, jnp.ones_like(begun)), r

    return (jnp.zeros(d), jnp.zeros(d), jnp.zeros(d), jnp.asarray(False)), update


def observed(observer: Observer, q: Any, qd: Any, tau: Any) -> Float[Array, "N d"]:
    """Returns the external torques r along a log of q, qd and tau [N, d], with tau[k] held from k to k + 1; pure."""
    start, update = observer
    tau = jnp.asarray(tau)
    held = jnp.concatenate([jnp.zeros_like(tau[:1]), tau[:-1]])
    rows = jnp.asarray(q), jnp.asarray(qd), held
    return jax.lax.scan(lambda memory, row: update(memory, *row), start, rows)[1]


def contact_threshold(scores: Any, *, rate: float, false_alarms: float) -> float:
    """Returns the score that motions without contact exceed at a stated rate.

    The largest scores in blocks of a second follow a generalised extreme value law, fitted by its probability-weighted
    moments (Hosking, Wallis and Wood 1985). It extrapolates to alarms that are rarer than one per recording. Alarms
    within a block count once.

    Args:
        scores: [N], of motions without contact like those to come; or a list of such recordings.
        rate: sampling rate, Hz.
        false_alarms: allowed number per hour.

    Raises:
        InputError: the scores last less than 20 s or are not finite, or one alarm per block or more is allowed.
    """
    from scipy.special import gamma
    from scipy.stats import genextreme

    require_positive(rate=rate, false_alarms=false_alarms)
    maxima = block_maxima(scores, rate=rate)
    if len(maxima) < LEAST_BLOCKS or not np.isfinite(maxima).all():
        raise InputError(
            f"there are {len(maxima)} s of scores without contact; expected {LEAST_BLOCKS} s or more, all finite"
        )
    share = false_alarms * BLOCK / 3600.0
    if not share < 1:
        raise InputError(f"false_alarms is {false_alarms} per hour; expected fewer than {3600 / BLOCK:g}")
    maxima, order = np.sort(maxima), np.arange(len(maxima)) / (len(maxima) - 1)
    later = (np.arange(len(maxima)) - 1) / (len(maxima) - 2)
    first, second, third = np.mean(maxima), np.mean(order * maxima), np.mean(order * later * maxima)
    c = (2 * second - first) / (3 * third - first) - math.log(2) / math.log(3)
    k = 7.8590 * c + 2.9554 * c**2
    k = k if abs(k) > 1e-6 else 1e-6  # a Gumbel law
    scale = (2 * second - first) * k / (gamma(1 + k) * (1 - 2**-k))
    return float(genextreme.isf(share, k, first + scale * (gamma(1 + k) - 1) / k, scale))


def block_maxima(scores: Any, *, rate: float) -> Float[np.ndarray, " B"]:
    """Returns the largest scores in the whole blocks of a second of recordings."""
    size = max(round(BLOCK * rate), 1)
    recordings = [np.asarray(part, float) for part in (scores if isinstance(scores, list | tuple) else [scores])]
    whole = [part[: len(part) // size * size].reshape(-1, size) for part in recordings]
    return np.concatenate([part.max(axis=1) for part in whole]) if whole else np.zeros(0)


def flange_wrench(
    jacobian: Any, tau: Any, *, length: float = 0.1, smallest: float = 1e-3
) -> tuple[Float[Array, " 6"], Bool[Array, ""], Scalar]:
    """Returns the wrench F at a flange as the least-squares solution of Jᵀ F = tau, in the ground frame.

    The first three components are the force, N, the others the moment about the flange's point, N m. The second result
    tells whether the torques determine all six of them; otherwise this is the shortest wrench that explains them. The
    third is the norm of the torques that no wrench at the flange explains, N m or N: a contact elsewhere.

    Args:
        jacobian: Jacobian of the flange's linear and angular velocity [6, d], by `frame_jacobian`.
        tau: external torques [d].
        length: length that makes moments comparable with forces, m.
        smallest: singular values of the scaled Jacobian below this share of the largest count as zero.
    """
    jacobian, tau = jnp.asarray(jacobian), jnp.asarray(tau)
    scale = jnp.concatenate([jnp.ones(3), jnp.full(3, 1 / length)])
    scaled = scale[:, None] * jacobian
    values, vectors = symmetric_eigen(scaled @ scaled.T)
    counts = values > smallest**2 * values[-1]
    along = vectors.T @ (scaled @ tau)
    wrench = scale * (vectors @ jnp.where(counts, along / jnp.where(counts, values, 1.0), 0.0))
    left = tau - jacobian.T @ wrench
    return wrench, jnp.all(counts), jnp.sqrt(left @ left)
