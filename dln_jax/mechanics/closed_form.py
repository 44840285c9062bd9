"""Equations of motion of natural systems with explicit mass matrix and forces, for one state.

    tau = M(q) qdd + c(q, qd) + g(q) [+ dD/dqd]

Closed forms take less time than derivatives of the energy, in which M is a second derivative.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics.dynamics import Decomposition, Dynamics, make_dynamics, minus_potential, plus_potential
from dln_jax.solvers import elimination
from dln_jax.types import Dissipation, Lagrangian, Potential, Scalar, Vector


class ClosedForm(NamedTuple):
    """Energies of a natural system and the resulting forces, as functions of one state."""

    mass_matrix: Callable[[Array], Array]
    """q -> M [d, d]."""
    coriolis: Callable[[Array, Array], Array]
    """(q, qd) -> c [d]."""
    potential: Potential | None = None
    """q -> V, scalar."""
    gravity: Callable[[Array], Array] | None = None
    """q -> g = dV/dq [d]; `None` exactly where there is no potential."""
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function D, scalar."""
    friction: Callable[[Array, Array], Array] | None = None
    """(q, qd) -> dD/dqd [d]; `None` exactly where there is no dissipation."""


def lagrangian(system: ClosedForm) -> Lagrangian:
    """L(q, qd) = ½ qdᵀ M(q) qd - V(q), for the generic functions of `mechanics.lagrangian`."""
    return lambda q, qd: minus_potential(0.5 * qd @ system.mass_matrix(q) @ qd, system.potential, q)


def decompose(system: ClosedForm, q: Vector, qd: Vector, qdd: Vector) -> Decomposition:
    """Inertial, Coriolis and gravity force, all [d]."""
    return Decomposition(
        inertial=system.mass_matrix(q) @ qdd,
        coriolis=system.coriolis(q, qd),
        gravity=jnp.zeros_like(q) if system.gravity is None else system.gravity(q),
    )


def inverse_dynamics(system: ClosedForm, q: Vector, qd: Vector, qdd: Vector) -> Vector:
    """Generalised force tau [d] of a motion, friction included."""
    tau = system.mass_matrix(q) @ qdd + system.coriolis(q, qd)
    if system.gravity is not None:
        tau += system.gravity(q)
    return tau if system.friction is None else tau + system.friction(q, qd)


def forward_dynamics(system: ClosedForm, q: Vector, qd: Vector, tau: Vector) -> Vector:
    """Acceleration qdd [d] under a generalised force: solves M qdd = tau - tau(q, qd, 0)."""
    bias = inverse_dynamics(system, q, qd, jnp.zeros_like(qd))
    return elimination.solve(system.mass_matrix(q), tau - bias)


def energy(system: ClosedForm, q: Vector, qd: Vector) -> Scalar:
    """Energy T + V."""
    return plus_potential(0.5 * qd @ system.mass_matrix(q) @ qd, system.potential, q)


def dynamics(system: ClosedForm, *, degrees_of_freedom: int | None = None) -> Dynamics:
    """Returns all functions of the system; with `degrees_of_freedom` they refuse states of another size."""
    return make_dynamics(
        inverse_dynamics=lambda q, qd, qdd: inverse_dynamics(system, q, qd, qdd),
        forward_dynamics=lambda q, qd, tau: forward_dynamics(system, q, qd, tau),
        energy=lambda q, qd: energy(system, q, qd),
        mass_matrix=lambda q, qd: system.mass_matrix(q),
        decompose=lambda q, qd, qdd: decompose(system, q, qd, qdd),
        dissipation=system.dissipation,
        degrees_of_freedom=degrees_of_freedom,
    )
