"""Equations of motion of natural systems with explicit mass matrix and forces, for one state.

    tau = M(q) qdd + c(q, qd) + g(q) [+ dD/dqd]

`ClosedForm` has the terms one by one, `RecursiveSystem` their sum from one recursion over bodies. Both take less time
than derivatives of the energy, because M is a second derivative of it.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics.dynamics import (
    Decomposition,
    Dynamics,
    decompose_by_differences,
    friction_of,
    make_dynamics,
    minus_potential,
    plus_potential,
)
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
    """q -> g = dV/dq [d]; `None` if and only if there is no potential."""
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function D, scalar."""
    friction: Callable[[Array, Array], Array] | None = None
    """(q, qd) -> dD/dqd [d] in closed form; by default the derivative of the dissipation."""


class RecursiveSystem(NamedTuple):
    """Energies of a natural system and the sum of the resulting forces, as functions of one state."""

    mass_matrix: Callable[[Array], Array]
    """q -> M [d, d]."""
    forces: Callable[[Array, Array, Array], Array]
    """(q, qd, qdd) -> tau [d], without friction."""
    potential: Potential | None = None
    """q -> V, scalar."""
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function D, scalar."""
    friction: Callable[[Array, Array], Array] | None = None
    """(q, qd) -> dD/dqd [d] in closed form; by default the derivative of the dissipation."""


Explicit = ClosedForm | RecursiveSystem
"""Energies with an explicit mass matrix."""


def lagrangian(system: Explicit) -> Lagrangian:
    """Returns L(q, qd) = ½ qdᵀ M(q) qd - V(q), for the generic functions of `mechanics.lagrangian`."""
    return lambda q, qd: minus_potential(0.5 * qd @ system.mass_matrix(q) @ qd, system.potential, q)


def energy(system: Explicit, q: Vector, qd: Vector) -> Scalar:
    """Returns the energy T + V."""
    return plus_potential(0.5 * qd @ system.mass_matrix(q) @ qd, system.potential, q)


def decompose(system: Explicit, q: Vector, qd: Vector, qdd: Vector) -> Decomposition:
    """Returns the inertial, Coriolis and gravity forces, all [d]."""
    if isinstance(system, RecursiveSystem):
        return decompose_by_differences(system.forces, q, qd, qdd)
    return Decomposition(
        inertial=system.mass_matrix(q) @ qdd,
        coriolis=system.coriolis(q, qd),
        gravity=jnp.zeros_like(q) if system.gravity is None else system.gravity(q),
    )


def forces(system: Explicit, q: Vector, qd: Vector, qdd: Vector) -> Vector:
    """Returns the generalised force tau [d] of a motion, without friction."""
    if isinstance(system, RecursiveSystem):
        return system.forces(q, qd, qdd)
    tau = system.mass_matrix(q) @ qdd + system.coriolis(q, qd)
    return tau if system.gravity is None else tau + system.gravity(q)


def inverse_dynamics(system: Explicit, q: Vector, qd: Vector, qdd: Vector) -> Vector:
    """Returns the generalised force tau [d] of a motion, including friction."""
    tau, friction = forces(system, q, qd, qdd), friction_of(system)
    return tau if friction is None else tau + friction(q, qd)


def dynamics(system: Explicit, *, degrees_of_freedom: int | None = None) -> Dynamics:
    """Returns all functions of the system; the forward model solves M qdd = tau - tau(q, qd, 0)."""

    def accelerate(q: Vector, qd: Vector, tau: Vector) -> Vector:
        return elimination.solve(system.mass_matrix(q), tau - forces(system, q, qd, jnp.zeros_like(qd)))

    return make_dynamics(
        system,
        partial(forces, system),
        accelerate,
        partial(decompose, system),
        partial(energy, system),
        lambda q, qd: system.mass_matrix(q),
        degrees_of_freedom=degrees_of_freedom,
    )
