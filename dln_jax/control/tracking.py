"""Tracking laws for mechanical systems, of one state; gains and torques are differentiable.

    gravity compensation    tau = g(q) + feedback
    feed-forward            tau = f(q*, qd*, qdd*) + feedback
    computed torque         tau = f(q, qd, qdd* + feedback)

with f the inverse dynamics of a known or learned model, and feedback = P (q* - q) + D (qd* - qd). Computed torque
evaluates the model at any measured state: with a bad model it is worse than feedback alone (`trusted`). If a state is
not finite, all torques are NaN.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool

from dln_jax.control.finite import where_finite
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.solvers.lapack import cholesky
from dln_jax.types import Vector


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
    """P (q* - q) + D (qd* - qd)."""
    return _times(gains.proportional, wanted.q - q) + _times(gains.derivative, wanted.qd - qd)


def gravity_compensation(plant: Dynamics | PlainDynamics, gains: Gains) -> Tracker:
    """Gravity of the present posture plus feedback: exact at rest."""

    def law(q: Vector, qd: Vector, wanted: Reference) -> Array:
        rest = jnp.zeros_like(qd)
        return where_finite(plant.inverse_dynamics(q, rest, rest) + feedback(gains, q, qd, wanted), q, qd)

    return law


def feed_forward(plant: Dynamics | PlainDynamics, gains: Gains) -> Tracker:
    """The model's torque on the reference plus feedback; the model is never evaluated at the measured state."""

    def law(q: Vector, qd: Vector, wanted: Reference) -> Array:
        planned = plant.inverse_dynamics(wanted.q, wanted.qd, wanted.qdd)
        return where_finite(planned + feedback(gains, q, qd, wanted), q, qd)

    return law


def computed_torque(plant: Dynamics | PlainDynamics, gains: Gains) -> Tracker:
    """The model's torque for the reference acceleration plus feedback; with an exact model, errors decay linearly.

    With gains [d] or matrices in 1/s² and 1/s, the error obeys e'' + D e' + P e = 0.
    """

    def law(q: Vector, qd: Vector, wanted: Reference) -> Array:
        tau = plant.inverse_dynamics(q, qd, wanted.qdd + feedback(gains, q, qd, wanted))
        return where_finite(tau, q, qd)

    return law


def limited(tau: Any, least: Any, most: Any) -> Array:
    """Clips a torque to the motors' limits; one that is not finite becomes NaN, for whoever handles the failure."""
    tau = jnp.asarray(tau)
    return jnp.where(jnp.isfinite(tau), jnp.clip(tau, least, most), jnp.nan)


def trusted(
    plant: Dynamics,
    first: Tracker,
    otherwise: Tracker,
    *,
    outside: Callable[[Vector, Vector, Vector], Any] | None = None,
    usable: bool = True,
) -> Callable[[Vector, Vector, Reference], tuple[Array, Array]]:
    """Returns a law that takes `first` where the model is usable and `otherwise` elsewhere, with a flag for the first.

    A model is usable if its mass matrix is positive definite (by a Cholesky factor) and the state is in distribution,
    as far as the model can test this. The other law should not evaluate the model at the state, such as `feed_forward`.

    Args:
        plant: the model.
        first: a law such as `computed_torque`.
        otherwise: a law such as `feed_forward`.
        outside: (q, qd, qdd) -> whether the state is out of distribution, for example from a run with uncertainty.
        usable: whether the model may be used at all, for example by `judgement.judged` on held-out motions.
    """
    credible = usable

    def law(q: Vector, qd: Vector, wanted: Reference) -> tuple[Array, Array]:
        usable = definite(plant, q) & credible
        if outside is not None:
            usable &= jnp.logical_not(outside(q, qd, wanted.qdd))
        return jnp.where(usable, first(q, qd, wanted), otherwise(q, qd, wanted)), usable

    return law


def definite(plant: Dynamics, q: Vector) -> Bool[Array, ""]:
    """Whether the mass matrix is positive definite."""
    return jnp.isfinite(cholesky(plant.mass_matrix(q))).all()


def _times(gain: Any, error: Any) -> Array:
    gain = jnp.asarray(gain)
    return gain @ error if gain.ndim == 2 else gain * error
