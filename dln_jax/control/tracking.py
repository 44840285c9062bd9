"""Laws that make a mechanical system follow references, of one state; gains and torques may be learned through.

    gravity compensation    tau = g(q) + feedback
    feed-forward            tau = f(q*, qd*, qdd*) + feedback
    computed torque         tau = f(q, qd, qdd* + feedback)

with f the inverse dynamics of a model, known or learned, and feedback = P (q* - q) + D (qd* - qd). Computed torque
trusts the model at the measured state, whatever that is: with a bad model it is worse than feedback alone
(`trusted`). Of a state that is not finite every torque is NaN.
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
    """Where the system is to be, each [d]."""

    q: Any
    qd: Any
    qdd: Any


class Gains(NamedTuple):
    """Of feedback: numbers, one for each joint [d], or matrices [d, d]."""

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
    """Holds the weight where the system is, beside feedback: exact at rest."""

    def law(q: Vector, qd: Vector, wanted: Reference) -> Array:
        rest = jnp.zeros_like(qd)
        return where_finite(plant.inverse_dynamics(q, rest, rest) + feedback(gains, q, qd, wanted), q, qd)

    return law


def feed_forward(plant: Dynamics | PlainDynamics, gains: Gains) -> Tracker:
    """The model's torque on the reference, beside feedback; what the state does cannot upset the model."""

    def law(q: Vector, qd: Vector, wanted: Reference) -> Array:
        planned = plant.inverse_dynamics(wanted.q, wanted.qd, wanted.qdd)
        return where_finite(planned + feedback(gains, q, qd, wanted), q, qd)

    return law


def computed_torque(plant: Dynamics | PlainDynamics, gains: Gains) -> Tracker:
    """The model's torque for an acceleration that takes errors back; with an exact model they decay linearly.

    With gains [d] or matrices in 1/s² and 1/s, the error obeys e'' + D e' + P e = 0.
    """

    def law(q: Vector, qd: Vector, wanted: Reference) -> Array:
        tau = plant.inverse_dynamics(q, qd, wanted.qdd + feedback(gains, q, qd, wanted))
        return where_finite(tau, q, qd)

    return law


def limited(tau: Any, least: Any, most: Any) -> Array:
    """A torque within the motors' limits; one that is not finite is NaN, for whoever holds the brake."""
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
    """One law where the model can be used at the state, and another where it cannot, with whether it was the first.

    A model can be used where its mass matrix is positive definite (by a Cholesky factor) and the state is within its
    data, if it can tell. The other law is one that does not ask the model at the state, such as `feed_forward`.

    Args:
        plant: the model.
        first: a law such as `computed_torque`.
        otherwise: a law such as `feed_forward`.
        outside: (q, qd, qdd) -> whether the state is outside the data, such as that of a run with uncertainty.
        usable: whether the model may be used at all, such as `judgement.judged` says of held-out motions.
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
