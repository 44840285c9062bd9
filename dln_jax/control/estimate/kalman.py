"""Kalman filters for one state: `predict` and `update` a belief, given a process with disturbances and noise.

    x' = step(x, u, w),   w ~ N(0, disturbance²),      y = measured(x) + v,   v ~ N(0, noise²)

For a mechanical system x = (q, qd), and w is an unmodelled torque, held for a sample: friction, model errors, a push.
Its standard deviation is the torque band of the model. An encoder with step s rounds q, which adds the variance s² /
12.

The extended filter linearises the process at the estimate, by forward-mode derivatives:

    x' = step(x, u, 0),   P' = F P Fᵀ + G diag(disturbance²) Gᵀ,   F = d step/dx,  G = d step/dw

The unscented filter evaluates it at points of the belief, without derivatives. With N = n + k columns s_j of a square
root of the covariance of (x, w), the 2 N points mean +- √N s_j have the weight 1 / (2 N) each (Julier and Uhlmann 1997
with kappa = 0; Arasaratnam and Haykin 2009, "Cubature Kalman filters"). It is exact to second order. Weights are
positive, so a triangular factor of the scaled differences is a square root of the covariance. For a linear process both
equal the Kalman filter.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from dln_jax.control.state_space import field_of, integrated
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.types import InputError, Scalar, require_positive


class Process(NamedTuple):
    """A plant in sampled time, for filters."""

    step: Callable[[Array, Array, Array], Array]
    """(x [n], u [m], w [k]) -> x [n] a sample later."""
    measured: Callable[[Array], Array]
    """x -> y [p]."""
    disturbance: Any
    """Standard deviation of w [k], or a function (x, u) -> [k] such as the torque band of a learned model."""
    noise: Any
    """Standard deviation of v [p], above zero."""
    unscented: bool = False
    """True: filters evaluate the process at points of the belief. False: they linearise it."""

    def deviation(self, x: Array, u: Array) -> Array:
        """Returns the standard deviation of w [k] at a state."""
        value = self.disturbance(x, u) if callable(self.disturbance) else self.disturbance
        return jnp.asarray(value, x.dtype)


class Belief(NamedTuple):
    """Normal distribution of the state: mean x and covariance W Wᵀ, which is never negative."""

    x: Float[Array, " n"]
    W: Float[Array, "n n"]


class Innovation(NamedTuple):
    """Unpredicted part of a measurement: independent normal residuals for a correct process."""

    residual: Float[Array, " p"]
    """Measurement minus its prediction from all earlier measurements, channel by channel; 0 if unseen."""
    variance: Float[Array, " p"]
    """Predicted variance of the residual; 1 if unseen."""
    seen: Bool[Array, " p"]


def mechanical(
    model: Dynamics | InverseForward,
    actuation: Any = None,
    *,
    rate: float,
    band: Any,
    encoder_step: Any = 0.0,
    encoder_noise: Any = 0.0,
    substeps: int = 1,
) -> Process:
    """Returns the process of a mechanical system with measured coordinates q.

    Args:
        model: known or learned.
        actuation: matrix [d, m] in tau = actuation u; by default every coordinate has its own motor.
        rate: sampling rate, Hz.
        band: standard deviation of the unmodelled torques [d], N m or N, or (x, u) -> [d].
        encoder_step: resolution of the coordinates [d], or one for all, rad or m.
        encoder_noise: standard deviation of additional noise [d], or one for all, rad or m.
        substeps: integrator steps per sample.

    Raises:
        InputError: the rate is not positive, a number is negative, or a coordinate has neither step nor noise.
    """
    require_positive(rate=rate)
    noise = np.sqrt(np.asarray(encoder_step, float) ** 2 / 12 + np.asarray(encoder_noise, float) ** 2)
    if not (noise > 0).all():
        raise InputError("a coordinate has neither encoder_step nor encoder_noise; expected one of them positive")
    if not callable(band) and not (np.asarray(band, float) >= 0).all():
        raise InputError(f"band is {np.asarray(band).tolist()}; expected standard deviations of 0 or more")
    B = None if actuation is None else jnp.asarray(actuation, float)
    held = integrated(field_of(model), 1.0 / rate, substeps=substeps)

    def step(x: Array, u: Array, w: Array) -> Array:
        return held(x, (u if B is None else B @ u) + w)

    return Process(step, lambda x: jnp.split(x, 2)[0], band, noise)


def belief(x: Any, deviation: Any) -> Belief:
    """Returns a belief with independent coordinates.

    Args:
        x: mean [n].
        deviation: standard deviations [n], or one for all, above zero.

    Raises:
        InputError: a standard deviation is not positive.
    """
    x = jnp.asarray(x, float)
    deviation = np.broadcast_to(np.asarray(deviation, float), x.shape)
    if not (deviation > 0).all():
        raise InputError(f"deviation is {deviation.tolist()}; expected positive standard deviations")
    return Belief(x, jnp.diag(jnp.asarray(deviation, x.dtype)))


def predict(process: Process, belief: Belief, u: Array) -> Belief:
    """Returns the belief a sample later, with the controls u [m] held."""
    x, W = belief
    deviation = process.deviation(x, u)
    if process.unscented:
        n = len(x)
        size = n + len(deviation)
        offsets = math.sqrt(size) * jax.scipy.linalg.block_diag(W.T, jnp.diag(deviation))
        both = jnp.concatenate([offsets, -offsets])
        points = jax.vmap(lambda offset: process.step(x + offset[:n], u, offset[n:]))(both)
        mean = jnp.mean(points, axis=0)
        return Belief(mean, _triangular((points - mean).T / math.sqrt(2 * size)))
    none = jnp.zeros_like(deviation)
    F, G = jax.jacfwd(process.step, argnums=(0, 2))(x, u, none)
    return Belief(process.step(x, u, none), _triangular(jnp.concatenate([F @ W, G * deviation], axis=1)))


def update(process: Process, belief: Belief, y: Array, seen: Any = True) -> tuple[Belief, Innovation]:
    """Returns the belief with measurements y [p], and the innovation; channels with `seen` [p] false are ignored.

    The measurements y = predicted + slopes z + v with x = mean + W z, z ~ N(0, 1), are added one channel after the
    other, in Potter's square-root form (Bierman 1977, "Factorization methods for discrete sequential estimation",
    chapter V): with a = Tᵀ slope and S = aᵀ a + variance, T <- T (1 - a aᵀ / (S + √(variance S))). The covariance stays
    positive, and no matrix is inverted.
    """
    x, W = belief
    seen = jnp.broadcast_to(jnp.asarray(seen, bool), y.shape)
    variance = jnp.broadcast_to(jnp.asarray(process.noise, x.dtype), y.shape) ** 2
    if process.unscented:
        reach = math.sqrt(len(x))
        above, below = (jax.vmap(process.measured)(x + sign * reach * W.T) for sign in (1.0, -1.0))
        predicted = jnp.mean((above + below) / 2, axis=0)
        slopes = (above - below).T / (2 * reach)
        # Curvature of the measurement counts as noise: the part of its variance beyond the slopes.
        variance += jnp.mean(((above + below) / 2 - predicted) ** 2, axis=0)
    else:
        predicted = process.measured(x)
        slopes = jax.jacfwd(process.measured)(x) @ W
    z, T = jnp.zeros_like(x), jnp.eye(len(x), dtype=x.dtype)
    residuals, variances = [], []
    for channel, slope in enumerate(slopes):
        a = T.T @ slope
        S = a @ a + variance[channel]
        residual = jnp.where(seen[channel], y[channel] - predicted[channel] - slope @ z, 0.0)
        along = T @ a
        z = z + along * (residual / S)
        shrink = jnp.where(seen[channel], 1.0 / (S + jnp.sqrt(variance[channel] * S)), 0.0)
        T = T - shrink * jnp.outer(along, a)
        residuals.append(residual)
        variances.append(jnp.where(seen[channel], S, 1.0))
    return Belief(x + W @ z, W @ T), Innovation(jnp.stack(residuals), jnp.stack(variances), seen)


def filtered(
    process: Process, belief: Belief, y: Float[Array, "N p"], u: Float[Array, "N m"], seen: Any = True
) -> tuple[Float[Array, "N n"], Innovation]:
    """Filters a log: returns estimates of the states at its samples, and the innovations [N, p]; pure.

    Args:
        process: such as `mechanical(...)`.
        belief: belief in the state before the first measurement.
        y: measurements.
        u: controls that act from each sample to the next.
        seen: True for channels with a measurement at a sample, [N, p], [p] or one for all.
    """
    y = jnp.asarray(y)
    seen = jnp.broadcast_to(jnp.asarray(seen, bool), y.shape)

    def sample(belief: Belief, row: tuple[Array, Array, Array]) -> tuple[Belief, tuple[Array, Innovation]]:
        y, u, seen = row
        belief, innovation = update(process, belief, y, seen)
        return predict(process, belief, u), (belief.x, innovation)

    return jax.lax.scan(sample, belief, (y, jnp.asarray(u), seen))[1]


def consistency(innovation: Innovation) -> Scalar:
    """Returns the mean of r² / S over the measurements: 1 for a correct process, above 1 for an overconfident one."""
    r, S, seen = innovation
    return jnp.sum(jnp.where(seen, r**2 / S, 0.0)) / jnp.maximum(jnp.sum(seen), 1)


def _triangular(A: Float[Array, "n m"]) -> Float[Array, "n n"]:
    """Returns the lower triangular L with L Lᵀ = A Aᵀ, m >= n, by the modified Gram-Schmidt process on the rows.

    It never forms A Aᵀ, which would square the condition number (Golub and Van Loan 2013, section 5.2.8). A row that
    depends on the rows above it gets a zero on the diagonal.
    """
    columns = []
    for row in range(len(A)):
        size = jnp.sqrt(A[row] @ A[row])
        unit = A[row] / jnp.where(size > 0, size, 1.0)
        # Rows above are finished; they are orthogonal to this one up to rounding, which is ignored.
        column = jnp.where(jnp.arange(len(A)) >= row, A @ unit, 0.0)
        A = A - column[:, None] * unit
        columns.append(column)
    return jnp.stack(columns, axis=1)
