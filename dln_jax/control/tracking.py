"""Tracking laws for mechanical systems, friction compensation, and a check of a model before its use.

Laws are functions of one state; gains and torques are differentiable.

    gravity compensation    tau = g(q) + feedback
    feed-forward            tau = f(q*, qd*, qdd*) + feedback
    computed torque         tau = f(q, qd, qdd* + feedback)

with f the inverse dynamics of a known or learned model, and feedback = P (q* - q) + D (qd* - qd). Computed torque
evaluates the model at the measured state, so a bad model makes it worse than feedback alone (see `trusted`). If a state
is not finite, all torques are NaN.

Dry friction jumps when a joint reverses, and there a measured rate is mostly noise. With r = √(u² + s²) > |u|, the
compensation of a joint at rate u is

    gain (w F(r) + (1 - w) F(-r)),   w = (1 + u / r) / 2

This equals F(u) at rates well above the smoothing rate s. Below s, it is a straight line through zero with the
magnitude of friction at s: no jump, and no work at rest. A gain below 1 never compensates all friction, so it cannot
drive a joint.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from dln_jax.control.state_space import where_finite
from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.solvers.elimination import cholesky
from dln_jax.types import InputError, Vector, require_positive

GAIN = 0.9
"""Default gain of the friction compensation."""
TOLERANCE = 0.1
"""Largest nMSE of a joint's torques for a usable model: the unexplained share of their variance."""


class Reference(NamedTuple):
    """Desired position, velocity and acceleration, all [d]."""

    q: Any
    qd: Any
    qdd: Any


class Gains(NamedTuple):
    """Feedback gains: numbers, one per joint [d], or matrices [d, d]."""

    proportional: Any
    """N m/rad or N/m; 1/s² for computed torque."""
    derivative: Any
    """N m s/rad or N s/m; 1/s for computed torque."""


Tracker = Callable[[Vector, Vector, Reference], Array]
"""(q, qd, reference) -> tau [d]."""


def feedback(gains: Gains, q: Any, qd: Any, wanted: Reference) -> Array:
    """Returns P (q* - q) + D (qd* - qd)."""
    return _times(gains.proportional, wanted.q - q) + _times(gains.derivative, wanted.qd - qd)


def gravity_compensation(plant: Dynamics | InverseForward, gains: Gains) -> Tracker:
    """Returns the law: gravity at the present posture, plus feedback. Exact at rest."""

    def law(q: Vector, qd: Vector, wanted: Reference) -> Array:
        rest = jnp.zeros_like(qd)
        return where_finite(plant.inverse_dynamics(q, rest, rest) + feedback(gains, q, qd, wanted), q, qd)

    return law


def feed_forward(plant: Dynamics | InverseForward, gains: Gains) -> Tracker:
    """Returns the law: the model's torque on the reference, plus feedback. It never evaluates the model at the measured
    state."""

    def law(q: Vector, qd: Vector, wanted: Reference) -> Array:
        planned = plant.inverse_dynamics(wanted.q, wanted.qd, wanted.qdd)
        return where_finite(planned + feedback(gains, q, qd, wanted), q, qd)

    return law


def computed_torque(plant: Dynamics | InverseForward, gains: Gains) -> Tracker:
    """Returns the law: the model's torque at the measured state for the reference acceleration plus feedback.

    With an exact model, and gains [d] or matrices in 1/s² and 1/s, the error obeys e'' + D e' + P e = 0.
    """

    def law(q: Vector, qd: Vector, wanted: Reference) -> Array:
        tau = plant.inverse_dynamics(q, qd, wanted.qdd + feedback(gains, q, qd, wanted))
        return where_finite(tau, q, qd)

    return law


def trusted(
    plant: Dynamics,
    first: Tracker,
    otherwise: Tracker,
    *,
    out_of_distribution: Callable[[Vector, Vector, Vector], Any] | None = None,
    usable: bool = True,
) -> Callable[[Vector, Vector, Reference], tuple[Array, Array]]:
    """Returns a law that applies `first` where the model is usable and `otherwise` elsewhere, with a flag.

    A model is usable if its mass matrix is positive definite (Cholesky test) and the state is in distribution (if there
    is a test). `otherwise` should not evaluate the model at the state; `feed_forward` does not.

    Args:
        plant: the model.
        first: a law such as `computed_torque`.
        otherwise: a law such as `feed_forward`.
        out_of_distribution: (q, qd, qdd) -> True outside the training data, for example from a run with uncertainty.
        usable: False disables the model, for example after `judged` on held-out motions.
    """

    def law(q: Vector, qd: Vector, wanted: Reference) -> tuple[Array, Array]:
        trust = definite(plant, q) & usable
        if out_of_distribution is not None:
            trust &= jnp.logical_not(out_of_distribution(q, qd, wanted.qdd))
        return jnp.where(trust, first(q, qd, wanted), otherwise(q, qd, wanted)), trust

    return law


def definite(plant: Dynamics, q: Vector) -> Bool[Array, ""]:
    """Returns whether the mass matrix is positive definite."""
    return jnp.isfinite(cholesky(plant.mass_matrix(q))).all()


def _times(gain: Any, error: Any) -> Array:
    gain = jnp.asarray(gain)
    return gain @ error if gain.ndim == 2 else gain * error


class Judgement(NamedTuple):
    """Verdict on a model."""

    usable: bool
    line: str
    """The reason, in a sentence."""
    nmse: Float[np.ndarray, " d"]
    """Mean squared errors of the joints' torques, divided by their variances."""
    definite: float
    """Share of the states with a positive definite mass matrix."""


def judged(plant: Dynamics, held_out: Trajectories, *, tolerance: float = TOLERANCE) -> Judgement:
    """Decides whether a model explains held-out torques, with a positive definite mass matrix in all states.

    Args:
        plant: the model.
        held_out: motions like the later references, not used in the fit; joints with constant torques do not count.
        tolerance: largest nMSE of the worst joint.
    """
    require_positive(tolerance=tolerance)
    q, qd, qdd = (jnp.asarray(column) for column in (held_out.q, held_out.qd, held_out.qdd))
    tau = np.asarray(jax.jit(jax.vmap(plant.inverse_dynamics))(q, qd, qdd))
    share = float(np.mean(np.asarray(jax.jit(jax.vmap(lambda q: definite(plant, q)))(q))))
    variance = np.var(held_out.tau, axis=0)
    moved = variance > 0
    nmse = np.mean((tau - held_out.tau) ** 2, axis=0) / np.where(moved, variance, np.nan)
    # A non-finite error counts as the worst.
    worst = int(np.argmax(np.where(moved, np.where(np.isfinite(nmse), nmse, np.inf), -1.0)))
    usable = bool(nmse[worst] <= tolerance) and share == 1.0
    if share < 1:
        line = f"the mass matrix is not positive definite in {1 - share:.1%} of the held-out states"
    else:
        line = (
            f"{nmse[worst]:.2%} of joint {worst + 1}'s held-out torque variance is unexplained (limit {tolerance:.0%})"
        )
    verdict = "the model is used" if usable else "the model is not evaluated at the measured state"
    return Judgement(usable, f"{line}: {verdict}", nmse, share)


def without_friction(plant: Dynamics) -> Dynamics:
    """Removes the friction and keeps the energies: a linearisation should not contain the slope of friction at rest.

    Friction must add to the other forces, as it does without load-dependent friction.
    """
    return plant._replace(
        inverse_dynamics=lambda q, qd, qdd: plant.inverse_dynamics(q, qd, qdd) - plant.friction(q, qd),
        forward_dynamics=lambda q, qd, tau: plant.forward_dynamics(q, qd, tau + plant.friction(q, qd)),
        friction=lambda q, qd: jnp.zeros_like(qd),
    )


def friction_compensation(
    plant: Dynamics, active: Sequence[int], *, smoothing: Any, gain: float = GAIN
) -> Callable[[Vector, Vector], Array]:
    """Returns (q, qd) -> forces that compensate a share of the active joints' friction; qd is measured or desired.

    Args:
        plant: known or learned model with friction.
        active: joints with a motor.
        smoothing: s, rad/s or m/s, one per active joint or one for all: a few times the noise of a measured rate.
        gain: compensated share of the friction, above 0 and at most 1.

    Raises:
        InputError: a smoothing is not positive, or the gain is out of range.
    """
    for rate in np.ravel(smoothing):
        require_positive(smoothing=float(rate))
    if not 0 < gain <= 1:
        raise InputError(f"gain is {gain}; expected a share of the friction, above 0 and at most 1")
    driven = np.array(active)

    def forces(q: Vector, qd: Vector) -> Array:
        rate = qd[driven]
        size = jnp.sqrt(rate**2 + jnp.asarray(smoothing) ** 2)
        forwards = (1 + rate / size) / 2
        positive, negative = (plant.friction(q, qd.at[driven].set(side * size))[driven] for side in (1, -1))
        return gain * (forwards * positive + (1 - forwards) * negative)

    return forces
