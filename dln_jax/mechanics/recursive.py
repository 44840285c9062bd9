"""Equations of motion of natural systems whose forces come from one recursion over bodies, for one state.

tau = forces(q, qd, qdd) [+ dD/dqd],   forces = M(q) qdd + c(q, qd) + g(q)
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
    make_dynamics,
    minus_potential,
    plus_potential,
)
from dln_jax.solvers import elimination
from dln_jax.types import Dissipation, Lagrangian, Potential, Scalar, Vector


class RecursiveSystem(NamedTuple):
    """Energies of a natural system and the resulting forces, as functions of one state."""

    mass_matrix: Callable[[Array], Array]
    """q -> M [d, d]."""
    forces: Callable[[Array, Array, Array], Array]
    """(q, qd, qdd) -> tau [d], without friction."""
    potential: Potential | None = None
    """q -> V, scalar."""
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function D, scalar."""
    friction: Callable[[Array, Array], Array] | None = None
    """(q, qd) -> dD/dqd [d]; `None` exactly where there is no dissipation."""


def lagrangian(system: RecursiveSystem) -> Lagrangian:
    """L(q, qd) = ½ qdᵀ M(q) qd - V(q)."""
    return lambda q, qd: minus_potential(0.5 * qd @ system.mass_matrix(q) @ qd, system.potential, q)


def inverse_dynamics(system: RecursiveSystem, q: Vector, qd: Vector, qdd: Vector) -> Vector:
    """Generalised force tau [d] of a motion, friction included."""
    tau = system.forces(q, qd, qdd)
    return tau if system.friction is None else tau + system.friction(q, qd)


def forward_dynamics(system: RecursiveSystem, q: Vector, qd: Vector, tau: Vector) -> Vector:
    """Acceleration qdd [d] under a generalised force: solves M qdd = tau - tau(q, qd, 0)."""
    bias = inverse_dynamics(system, q, qd, jnp.zeros_like(qd))
    return elimination.solve(system.mass_matrix(q), tau - bias)


def decompose(system: RecursiveSystem, q: Vector, qd: Vector, qdd: Vector) -> Decomposition:
    """Inertial, Coriolis and gravity force, all [d]."""
    return decompose_by_differences(system.forces, q, qd, qdd)


def energy(system: RecursiveSystem, q: Vector, qd: Vector) -> Scalar:
    """Energy T + V."""
    return plus_potential(0.5 * qd @ system.mass_matrix(q) @ qd, system.potential, q)


def dynamics(system: RecursiveSystem, *, degrees_of_freedom: int | None = None) -> Dynamics:
    """Returns all functions of the system; with `degrees_of_freedom` they refuse states of another size."""
    return make_dynamics(
        partial(inverse_dynamics, system),
        partial(forward_dynamics, system),
        partial(decompose, system),
        partial(energy, system),
        lambda q, qd: system.mass_matrix(q),
        dissipation=system.dissipation,
        degrees_of_freedom=degrees_of_freedom,
    )
