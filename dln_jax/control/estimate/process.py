"""Model of a plant for filters: its step with random disturbances, its measurements, and their noise.

    x' = step(x, u, w),   w ~ N(0, disturbance²),      y = measured(x) + v,   v ~ N(0, noise²)

For a mechanical system x = (q, qd), and w is a torque that the model lacks, held for a sample: friction, model errors,
a push. Its standard deviation is the model's torque band. An encoder with step s rounds q, which adds the variance
s² / 12.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from dln_jax.control.state_space import integrated
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.types import InputError, require_positive


class Process(NamedTuple):
    """A plant in sampled time, for filters."""

    step: Callable[[Array, Array, Array], Array]
    """(x [n], u [m], w [k]) -> x [n] a sample later."""
    measured: Callable[[Array], Array]
    """x -> y [p]."""
    disturbance: Any
    """Standard deviation of w [k], or a function (x, u) -> [k] such as a learned model's torque band."""
    noise: Any
    """Standard deviation of v [p], above zero."""

    def deviation(self, x: Array, u: Array) -> Array:
        """Returns the standard deviation of w [k] at a state."""
        value = self.disturbance(x, u) if callable(self.disturbance) else self.disturbance
        return jnp.asarray(value, x.dtype)


class Belief(NamedTuple):
    """Normal distribution of the state: mean x and covariance P = W Wᵀ, which is never negative."""

    x: Float[Array, " n"]
    W: Float[Array, "n n"]

    @property
    def covariance(self) -> Array:
        """P [n, n]."""
        return self.W @ self.W.T


class Innovation(NamedTuple):
    """The part of a measurement that was not predicted: independent normal residuals if the process is right."""

    residual: Float[Array, " p"]
    """Measurement minus its prediction from all earlier ones, channel by channel; 0 if unseen."""
    variance: Float[Array, " p"]
    """Predicted variance of the residual; 1 if unseen."""
    seen: Bool[Array, " p"]


class Filter(NamedTuple):
    """An estimator of a process. Its memory is a tree of arrays with a field `x`, the estimate [n]."""

    process: Process
    start: Callable[[Belief], Any]
    """Belief in the state before the first measurement -> memory."""
    predict: Callable[[Any, Array], Any]
    """(memory, u held for a sample) -> memory a sample later."""
    update: Callable[[Any, Array, Array], tuple[Any, Innovation]]
    """(memory, y [p], seen [p]) -> memory with these measurements, and innovation; unseen channels are ignored."""


def mechanical(
    model: Dynamics | PlainDynamics,
    actuation: Any = None,
    *,
    rate: float,
    band: Any,
    encoder_step: Any = 0.0,
    encoder_noise: Any = 0.0,
    substeps: int = 1,
) -> Process:
    """Returns the process of a mechanical system whose coordinates q are measured.

    Args:
        model: known or learned.
        actuation: matrix [d, m] in tau = actuation u; by default every coordinate has its own motor.
        rate: sampling rate, Hz.
        band: standard deviation of the torques that the model lacks [d], N m or N, or (x, u) -> [d].
        encoder_step: resolution of the coordinates [d], or one for all, rad or m.
        encoder_noise: standard deviation of other noise of the coordinates [d], or one for all, rad or m.
        substeps: integrator steps per sample.

    Raises:
        InputError: the rate is not positive, a number is negative, or a coordinate has neither step nor noise.
    """
    require_positive(rate=rate)
    noise = np.sqrt(np.asarray(encoder_step, float) ** 2 / 12 + np.asarray(encoder_noise, float) ** 2)
    if not (noise > 0).all():
        raise InputError("a coordinate has neither encoder_step nor encoder_noise; expected one of them above zero")
    if not callable(band) and not (np.asarray(band, float) >= 0).all():
        raise InputError(f"band is {np.asarray(band).tolist()}; expected standard deviations of 0 or more")
    B = None if actuation is None else jnp.asarray(actuation, float)

    def field(x: Array, tau: Array) -> Array:
        q, qd = jnp.split(x, 2)
        return jnp.concatenate([qd, model.forward_dynamics(q, qd, tau)])

    held = integrated(field, 1.0 / rate, substeps=substeps)

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


def triangular(A: Float[Array, "n m"]) -> Float[Array, "n n"]:
    """Returns the lower triangular L with L Lᵀ = A Aᵀ, m >= n, by the modified Gram-Schmidt process on the rows.

    It never forms A Aᵀ, whose condition number is squared (Golub and Van Loan 2013, section 5.2.8). A row that depends
    on those above it has a zero on the diagonal.
    """
    columns = []
    for row in range(len(A)):
        size = jnp.sqrt(A[row] @ A[row])
        unit = A[row] / jnp.where(size > 0, size, 1.0)
        # Rows above this one are done; they are orthogonal to it up to rounding, which is left out.
        column = jnp.where(jnp.arange(len(A)) >= row, A @ unit, 0.0)
        A = A - column[:, None] * unit
        columns.append(column)
    return jnp.stack(columns, axis=1)


def corrected(
    belief: Belief, y: Array, seen: Array, predicted: Array, slopes: Array, variance: Array
) -> tuple[Belief, Innovation]:
    """Adds measurements y = predicted + slopes z + v with x = mean + W z, z ~ N(0, 1), one channel after the other.

    Potter's square-root form (Bierman 1977, "Factorization methods for discrete sequential estimation", chapter V):
    with a = Tᵀ slope and S = aᵀ a + variance, T <- T (1 - a aᵀ / (S + √(variance S))). The covariance stays positive,
    and no matrix is inverted.
    """
    seen = jnp.broadcast_to(jnp.asarray(seen, bool), y.shape)
    z, T = jnp.zeros_like(belief.x), jnp.eye(len(belief.x), dtype=belief.x.dtype)
    residuals, variances = [], []
    for channel in range(len(y)):
        slope = slopes[channel]
        a = T.T @ slope
        S = a @ a + variance[channel]
        residual = jnp.where(seen[channel], y[channel] - predicted[channel] - slope @ z, 0.0)
        along = T @ a
        z = z + along * (residual / S)
        shrink = jnp.where(seen[channel], 1.0 / (S + jnp.sqrt(variance[channel] * S)), 0.0)
        T = T - shrink * jnp.outer(along, a)
        residuals.append(residual)
        variances.append(jnp.where(seen[channel], S, 1.0))
    after = Belief(belief.x + belief.W @ z, belief.W @ T)
    return after, Innovation(jnp.stack(residuals), jnp.stack(variances), seen)
