"""Record of a textbook system: its `Needs`, exact energies, and equations of motion in closed form."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.mechanics import closed_form
from dln_jax.mechanics.closed_form import ClosedForm
from dln_jax.mechanics.dynamics import friction_force
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.types import Dissipation, Lagrangian, Needs, Potential, Vector


class Scene(NamedTuple):
    """A textbook mechanical system; symbols and units as in `dln_jax.types`.

    The energies define it. `coriolis` and `gravity` are written by hand, as an independent ground truth for anything
    derived from the energies.
    """

    name: str
    needs: Needs
    mass_matrix: Callable[[Array], Array]
    """q -> M [d, d]."""
    coriolis: Callable[[Array, Array], Array]
    """(q, qd) -> c [d]."""
    potential: Potential | None = None
    """q -> V; `None` if and only if the needs state no gravity."""
    gravity: Potential | None = None
    """q -> dV/dq [d]."""
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function; `None` if and only if the needs state no friction."""
    tip: Callable[[Array], Array] | None = None
    """q -> position [2] of the last body in m, for figures; y points up."""

    @property
    def closed_form(self) -> ClosedForm:
        """The energies and hand-written forces, for the functions of `mechanics.closed_form`."""
        D = self.dissipation
        friction = None if D is None else functools.partial(friction_force, D)
        return ClosedForm(self.mass_matrix, self.coriolis, self.potential, self.gravity, D, friction)

    @property
    def lagrangian(self) -> Lagrangian:
        """The textbook L(q, qd) = ½ qdᵀ M(q) qd - V(q)."""
        return closed_form.lagrangian(self.closed_form)

    @property
    def energies(self) -> LagrangianSystem:
        """The energies in the record that mechanics takes, as for models."""
        return LagrangianSystem(self.lagrangian, self.dissipation)


def closed_form_forward_dynamics(scene: Scene, q: Vector, qd: Vector, tau: Vector) -> Vector:
    """Acceleration qdd [d] by the textbook formulas.

    LAPACK solves for it, on whose last digits generated datasets depend.
    """
    bias = closed_form.inverse_dynamics(scene.closed_form, q, qd, jnp.zeros_like(qd))
    return jnp.linalg.solve(scene.mass_matrix(q), tau - bias)


def no_coriolis(q: Vector, qd: Vector) -> Vector:
    """Coriolis force for a constant mass matrix."""
    return jnp.zeros_like(q)


def actuation_matrix(needs: Needs) -> Float[Array, "d u"]:
    """B [d, u] in tau = B control; the identity if every coordinate has its own motor."""
    if needs.actuation is None:
        return jnp.eye(needs.degrees_of_freedom)
    return jnp.asarray(needs.actuation)


def viscous_dissipation(coefficient: float) -> Dissipation | None:
    """D = ½ b |qd|², friction torque b qd; `None` if b (N m s or N s/m) is zero."""
    if coefficient == 0.0:
        return None
    return lambda q, qd: 0.5 * coefficient * jnp.sum(qd**2)
