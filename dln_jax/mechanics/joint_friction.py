"""Friction in the joints of any system, and transmission friction proportional to the transmitted force.

    tau = tau_link + μ |tau_link| tanh(u / v) + dD/dqd,   tau_link = M qdd + c + g

for every joint, with the joint's rate u. Load-dependent friction has no Rayleigh function of qd, because the
transmitted force depends on the acceleration. But for μ < 1 the map from tau_link to tau is piecewise linear with
positive slopes 1 ± μ tanh, and its inverse keeps the sign:

    tau_link = y / (1 + sign(y) μ tanh(u / v)),   y = tau - dD/dqd

The corner at tau_link = 0 remains; its derivative is the mean of both sides (μ = 0). Free motion (tau = 0) loses no
power to load friction unless other friction loads the transmission.
"""

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.mechanics.dynamics import InverseForward, PhaseRates, friction_force
from dln_jax.mechanics.friction import joint_rates
from dln_jax.types import Dissipation, Potential, Vector


class Load(NamedTuple):
    """Transmission friction proportional to the transmitted force."""

    share: Any
    """μ, one per joint [d] or one for all, 0 <= μ < 1."""
    velocity_scale: Any = 0.01
    """v, 1/s or m/s."""
    joint_map: Any = None
    """Known matrix J [d, d] in joint rates = J qd; `None` if the coordinates are the joints' own."""


class LoadedSystem(NamedTuple):
    """Any energies behind transmissions with load-dependent friction."""

    link: Any
    """The record without dissipation."""
    load: Load
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function D, scalar, of the motors' own friction."""

    @property
    def potential(self) -> Potential | None:
        """Potential of the links."""
        return getattr(self.link, "potential", None)


def with_friction(system: Any, dissipation: Dissipation | None, load: Load | None = None) -> Any:
    """Returns the same system with additional friction in its joints.

    A system without an energy keeps its kind; the inverse model adds the force, the forward model or rates subtract it.

    Args:
        system: one of `mechanics.equations.System`.
        dissipation: (q, qd) -> Rayleigh function, as from `joint_dissipation`.
        load: load-dependent friction of the transmissions; all other friction then acts on the motor side.

    Returns:
        The record, or with a load a `LoadedSystem`.
    """
    if dissipation is None and load is None:
        return system
    if isinstance(system, InverseForward | PhaseRates):
        return _plain(system, LoadedSystem(None, load or Load(0.0), dissipation))
    if dissipation is not None:
        system = _dissipating(system, sum_of(system.dissipation, dissipation))
    if load is None:
        return system
    return LoadedSystem(_dissipating(system, None), load, system.dissipation)


def sum_of(first: Callable[..., Array] | None, second: Callable[..., Array]) -> Callable[..., Array]:
    """Returns the sum of two functions of a state; an absent one is never traced."""
    return second if first is None else lambda *state: first(*state) + second(*state)


def carrying(load: Load, qd: Vector, tau_link: Vector) -> Vector:
    """Returns the generalised force tau [d] before the transmissions, from tau_link behind them."""
    return _through(load, qd, tau_link, operator.mul)


def carried(load: Load, qd: Vector, tau: Vector) -> Vector:
    """Returns the generalised force tau_link [d] behind the transmissions, from tau before them; inverts `carrying`."""
    return _through(load, qd, tau, operator.truediv)


def _through(load: Load, qd: Vector, tau: Vector, by: Callable[[Array, Array], Array]) -> Vector:
    """Multiplies or divides the forces at the joints, which Jᵀ maps to generalised forces, by 1 ± μ tanh(u / v)."""
    J = None if load.joint_map is None else np.asarray(load.joint_map, float)
    at_joints = tau if J is None else jnp.asarray(np.linalg.inv(J).T, tau.dtype) @ tau
    slope = jnp.asarray(load.share, qd.dtype) * jnp.tanh(joint_rates(load.joint_map, qd) / load.velocity_scale)
    # The sign has derivative 0; the derivative of the absolute value would be one-sided.
    at_joints = by(at_joints, 1 + jnp.sign(at_joints) * slope)
    return at_joints if J is None else jnp.asarray(J, tau.dtype).T @ at_joints


def link_force(system: LoadedSystem, q: Vector, qd: Vector, tau: Vector) -> Vector:
    """Returns the part of a generalised force that moves the links [d]."""
    if system.dissipation is not None:
        tau = tau - friction_force(system.dissipation, q, qd)
    return carried(system.load, qd, tau)


def _dissipating(system: Any, dissipation: Dissipation | None) -> Any:
    """Replaces the dissipation, and removes a friction force in closed form."""
    return system._replace(dissipation=dissipation, **({"friction": None} if "friction" in system._fields else {}))


def _plain(system: InverseForward | PhaseRates, friction: LoadedSystem) -> InverseForward | PhaseRates:
    if isinstance(system, PhaseRates):

        def rates(q: Vector, p: Vector) -> tuple[Array, Array]:
            qd, pd = system.rates(q, p)
            return qd, pd + link_force(friction, q, qd, jnp.zeros_like(qd))

        return PhaseRates(rates)

    def inverse(q: Vector, qd: Vector, qdd: Vector) -> Vector:
        tau = carrying(friction.load, qd, system.inverse_dynamics(q, qd, qdd))
        return tau if friction.dissipation is None else tau + friction_force(friction.dissipation, q, qd)

    return InverseForward(inverse, lambda q, qd, tau: system.forward_dynamics(q, qd, link_force(friction, q, qd, tau)))
