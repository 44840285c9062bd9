"""Equations of motion of natural systems with explicit mass matrix and forces, for one state.

    tau = M(q) qdd + c(q, qd) + g(q) [+ dD/dqd]

`closed_form` takes the terms one by one. An `ExplicitSystem` may also compute their sum in one recursion over bodies.
Both are faster than derivatives of the energy, because M is its second derivative.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics.dynamics import (
    Decomposition,
    Functions,
    decompose_by_differences,
    minus_potential,
    plus_potential,
)
from dln_jax.solvers import elimination
from dln_jax.types import Dissipation, Lagrangian, Potential, Scalar, Vector


class ExplicitSystem(NamedTuple):
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
    """(q, qd) -> dD/dqd [d] in closed form; by default the derivative of the dissipation."""
    decompose: Callable[[Array, Array, Array], Decomposition] | None = None
    """(q, qd, qdd) -> inertial, Coriolis and gravity forces, all [d]; by default by differences of `forces`."""


def closed_form(
    mass_matrix: Callable[[Array], Array],
    coriolis: Callable[[Array, Array], Array],
    potential: Potential | None = None,
    gravity: Callable[[Array], Array] | None = None,
    dissipation: Dissipation | None = None,
    friction: Callable[[Array, Array], Array] | None = None,
) -> ExplicitSystem:
    """Returns a system of explicit terms.

    Args:
        mass_matrix: q -> M [d, d].
        coriolis: (q, qd) -> c [d].
        potential: q -> V, scalar.
        gravity: q -> g = dV/dq [d]; `None` if and only if there is no potential.
        dissipation, friction: as in `ExplicitSystem`.
    """

    def forces(q: Vector, qd: Vector, qdd: Vector) -> Vector:
        tau = mass_matrix(q) @ qdd + coriolis(q, qd)
        return tau if gravity is None else tau + gravity(q)

    def decompose(q: Vector, qd: Vector, qdd: Vector) -> Decomposition:
        weight = jnp.zeros_like(q) if gravity is None else gravity(q)
        return Decomposition(mass_matrix(q) @ qdd, coriolis(q, qd), weight)

    return ExplicitSystem(mass_matrix, forces, potential, dissipation, friction, decompose)


def lagrangian(system: ExplicitSystem) -> Lagrangian:
    """Returns L(q, qd) = ½ qdᵀ M(q) qd - V(q), for the generic functions of `mechanics.lagrangian`."""
    return lambda q, qd: minus_potential(0.5 * qd @ system.mass_matrix(q) @ qd, system.potential, q)


def functions(system: ExplicitSystem) -> Functions:
    """Returns the functions of the system; the forward model solves M qdd = tau - tau(q, qd, 0)."""

    def accelerate(q: Vector, qd: Vector, tau: Vector) -> Vector:
        return elimination.solve(system.mass_matrix(q), tau - system.forces(q, qd, jnp.zeros_like(qd)))

    def energy(q: Vector, qd: Vector) -> Scalar:
        return plus_potential(0.5 * qd @ system.mass_matrix(q) @ qd, system.potential, q)

    decompose = system.decompose or partial(decompose_by_differences, system.forces)
    return system.forces, accelerate, energy, lambda q, qd: system.mass_matrix(q), decompose
