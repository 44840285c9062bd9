"""Systems whose transmissions have friction proportional to the force that they carry, for one state.

    tau = tau_link + μ |tau_link| tanh(u / v) + dD/dqd,   tau_link = M qdd + c + g

joint by joint, u the joint's rate. This is no Rayleigh function of qd, because the carried force depends on the
acceleration. But for μ < 1 the map from tau_link to tau is piecewise linear with positive slopes 1 ± μ tanh, and its
inverse keeps the sign:

    tau_link = y / (1 + sign(y) μ tanh(u / v)),   y = tau - dD/dqd

The corner at tau_link = 0 remains: derivatives there are those of μ = 0, the mean of both sides. Free motion (tau = 0)
loses nothing by load unless other friction loads the transmission.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics, friction_force, make_dynamics, make_plain_dynamics
from dln_jax.mechanics.friction import joint_rates
from dln_jax.types import Dissipation, Potential, Vector


class Load(NamedTuple):
    """Friction proportional to the force that a transmission carries."""

    share: Any
    """μ, one per joint [d] or one for all, 0 <= μ < 1."""
    velocity_scale: Any = 0.01
    """v, 1/s or m/s."""
    joint_map: Any = None
    """Known matrix J [d, d] of joint rates J qd; `None` if the coordinates are those of the joints."""


class LoadedSystem(NamedTuple):
    """Any system with applied forces, behind transmissions with friction that depends on load."""

    link: Any
    """The record without dissipation."""
    load: Load
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function D, scalar, of the other friction that the motors overcome."""

    @property
    def potential(self) -> Potential | None:
        """Potential of the links."""
        return getattr(self.link, "potential", None)


def carrying(load: Load, qd: Vector, tau_link: Vector) -> Vector:
    """Generalised force tau [d] before the transmissions, from tau_link behind them."""
    at_joints = _to_joints(load, tau_link)
    # By the sign, whose derivative is 0; that of the absolute value is one-sided.
    return _from_joints(load, at_joints * (1 + jnp.sign(at_joints) * _slope(load, qd)))


def carried(load: Load, qd: Vector, tau: Vector) -> Vector:
    """Generalised force tau_link [d] behind the transmissions, from tau before them: the inverse of `carrying`."""
    at_joints = _to_joints(load, tau)
    return _from_joints(load, at_joints / (1 + jnp.sign(at_joints) * _slope(load, qd)))


def link_force(system: LoadedSystem, q: Vector, qd: Vector, tau: Vector) -> Vector:
    """Part of a generalised force that moves the links [d]."""
    if system.dissipation is not None:
        tau = tau - friction_force(system.dissipation, q, qd)
    return carried(system.load, qd, tau)


def dynamics(
    system: LoadedSystem, link: Dynamics | PlainDynamics, *, degrees_of_freedom: int | None = None
) -> Dynamics | PlainDynamics:
    """Returns all functions of the system, from those of its links.

    `friction(q, qd)` is that of the dissipation alone, and `decompose` is of the links.
    """

    def inverse_dynamics(q: Vector, qd: Vector, qdd: Vector) -> Vector:
        tau = carrying(system.load, qd, link.inverse_dynamics(q, qd, qdd))
        return tau if system.dissipation is None else tau + friction_force(system.dissipation, q, qd)

    def forward_dynamics(q: Vector, qd: Vector, tau: Vector) -> Vector:
        return link.forward_dynamics(q, qd, link_force(system, q, qd, tau))

    make = partial(make_plain_dynamics, degrees_of_freedom=degrees_of_freedom)
    if isinstance(link, Dynamics):
        parts = {"energy": link.energy, "mass_matrix": link.mass_matrix, "dissipation": system.dissipation}
        make = partial(make_dynamics, **parts, degrees_of_freedom=degrees_of_freedom)
    return make(inverse_dynamics, forward_dynamics, link.decompose)


def _slope(load: Load, qd: Vector) -> Vector:
    """μ tanh(u / v), within (-1, 1)."""
    return jnp.asarray(load.share, qd.dtype) * jnp.tanh(joint_rates(load.joint_map, qd) / load.velocity_scale)


def _to_joints(load: Load, tau: Vector) -> Vector:
    """Forces at the joints; Jᵀ maps them to generalised forces."""
    if load.joint_map is None:
        return tau
    return jnp.asarray(np.linalg.inv(np.asarray(load.joint_map, float)).T, tau.dtype) @ tau


def _from_joints(load: Load, force: Vector) -> Vector:
    return force if load.joint_map is None else jnp.asarray(load.joint_map, force.dtype).T @ force
