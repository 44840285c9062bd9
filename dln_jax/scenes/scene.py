"""What a textbook system carries: its needs, its exact energies, and its equations of motion in closed form."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.mechanics.dynamics import Decomposition, friction_force
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.types import Dissipation, Lagrangian, Needs, Potential, Scalar, Vector


class Scene(NamedTuple):
    """A textbook mechanical system; symbols and units as in `dln_jax.types`.

    The energies define it. `coriolis` and `gravity` are written out by hand, so that they are an independent
    ground truth for whatever is derived from the energies.
    """

    name: str
    needs: Needs
    mass_matrix: Callable[[Array], Array]
    """q -> M [d, d]."""
    coriolis: Callable[[Array, Array], Array]
    """(q, qd) -> c [d]."""
    potential: Potential | None = None
    """q -> V; `None` exactly when the needs state no gravity."""
    gravity: Potential | None = None
    """q -> dV/dq [d]."""
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function; `None` exactly when the needs state no friction."""
    tip: Callable[[Array], Array] | None = None
    """q -> position [2] of the last body in m, for figures; y points up."""

    @property
    def lagrangian(self) -> Lagrangian:
        """The textbook L(q, qd) = ½ qdᵀ M(q) qd - V(q)."""
        return functools.partial(_lagrangian, self)

    @property
    def energies(self) -> LagrangianSystem:
        """The record of energies that the mechanics takes, as those of models."""
        return LagrangianSystem(self.lagrangian, self.dissipation)


def closed_form_decomposition(scene: Scene, q: Vector, qd: Vector, qdd: Vector) -> Decomposition:
    """Inertial, Coriolis and gravity force, each [d], by the textbook formulas."""
    return Decomposition(
        inertial=scene.mass_matrix(q) @ qdd,
        coriolis=scene.coriolis(q, qd),
        gravity=jnp.zeros_like(q) if scene.gravity is None else scene.gravity(q),
    )


def closed_form_inverse_dynamics(scene: Scene, q: Vector, qd: Vector, qdd: Vector) -> Vector:
    """Generalised force tau [d] by the textbook formulas, friction included."""
    tau = sum(closed_form_decomposition(scene, q, qd, qdd), jnp.zeros_like(q))
    if scene.dissipation is None:
        return tau
    return tau + friction_force(scene.dissipation, q, qd)


def closed_form_forward_dynamics(scene: Scene, q: Vector, qd: Vector, tau: Vector) -> Vector:
    """Acceleration qdd [d] by the textbook formulas."""
    bias = closed_form_inverse_dynamics(scene, q, qd, jnp.zeros_like(qd))
    return jnp.linalg.solve(scene.mass_matrix(q), tau - bias)


def actuation_matrix(needs: Needs) -> Float[Array, "d u"]:
    """B [d, u] in tau = B control: the identity where every coordinate has its own motor."""
    if needs.actuation is None:
        return jnp.eye(needs.degrees_of_freedom)
    return jnp.asarray(needs.actuation)


def viscous_dissipation(coefficient: float) -> Dissipation | None:
    """D = ½ b |qd|², friction torque b qd; `None` when b, in N m s or N s/m, is zero."""
    if coefficient == 0.0:
        return None
    return lambda q, qd: 0.5 * coefficient * jnp.sum(qd**2)


def _lagrangian(scene: Scene, q: Vector, qd: Vector) -> Scalar:
    kinetic = 0.5 * qd @ scene.mass_matrix(q) @ qd
    return kinetic if scene.potential is None else kinetic - scene.potential(q)
