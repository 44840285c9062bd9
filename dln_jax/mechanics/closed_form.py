"""Equations of motion of natural systems whose mass matrix and forces are written out, for one state.

    tau = M(q) qdd + c(q, qd) + g(q) [+ dD/dqd]

Where closed forms are at hand they take less time than derivatives of the energy, in which M is a second one.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics.dynamics import Decomposition, Dynamics, make_dynamics
from dln_jax.solvers import elimination
from dln_jax.types import Dissipation, Lagrangian, Potential, Scalar, Vector


class ClosedForm(NamedTuple):
    """The energies of a natural system and the forces that follow from them, as functions of one state."""

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

    def difference(q: Vector, qd: Vector) -> Scalar:
        kinetic = 0.5 * qd @ system.mass_matrix(q) @ qd
        return kinetic if system.potential is None else kinetic - system.potential(q)

    return difference


def dynamics(system: ClosedForm, *, degrees_of_freedom: int | None = None) -> Dynamics:
    """All functions of the system at once; with `degrees_of_freedom` they refuse states of another size."""
    mass_matrix, coriolis, potential, gravity, dissipation, friction = system

    def inverse_dynamics(q: Vector, qd: Vector, qdd: Vector) -> Vector:
        tau = mass_matrix(q) @ qdd + coriolis(q, qd)
        if gravity is not None:
            tau += gravity(q)
        return tau if friction is None else tau + friction(q, qd)

    def forward_dynamics(q: Vector, qd: Vector, tau: Vector) -> Vector:
        bias = inverse_dynamics(q, qd, jnp.zeros_like(qd))
        return elimination.solve(mass_matrix(q), tau - bias)

    def energy(q: Vector, qd: Vector) -> Scalar:
        kinetic = 0.5 * qd @ mass_matrix(q) @ qd
        return kinetic if potential is None else kinetic + potential(q)

    def decompose(q: Vector, qd: Vector, qdd: Vector) -> Decomposition:
        return Decomposition(
            inertial=mass_matrix(q) @ qdd,
            coriolis=coriolis(q, qd),
            gravity=jnp.zeros_like(q) if gravity is None else gravity(q),
        )

    return make_dynamics(
        inverse_dynamics,
        forward_dynamics,
        decompose,
        energy,
        lambda q, qd: mass_matrix(q),
        dissipation=dissipation,
        degrees_of_freedom=degrees_of_freedom,
    )
