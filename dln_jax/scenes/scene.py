"""Record of a textbook system: its `Needs`, exact energies, closed-form equations of motion and joint friction."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from dln_jax.mechanics import explicit
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.explicit import ExplicitSystem
from dln_jax.mechanics.friction import FrictionCoefficients, FrictionShape, joint_dissipation
from dln_jax.mechanics.joint_friction import sum_of
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.types import Dissipation, FrictionLaw, InputError, JointKind, Lagrangian, Needs, Potential, Vector

LAWS: tuple[FrictionLaw, ...] = ("viscous", "coulomb", "stribeck")
"""Friction laws available for a scene; the other laws of `mechanics.friction` describe gears."""


class Scene(NamedTuple):
    """A textbook mechanical system; symbols and units as in `dln_jax.types`.

    The energies define it. `coriolis` and `gravity` are textbook formulas: an independent ground truth for functions
    that are derived from the energies.
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
    def closed_form(self) -> ExplicitSystem:
        """The energies and textbook forces, for the functions of `mechanics.explicit`."""
        return explicit.closed_form(self.mass_matrix, self.coriolis, self.potential, self.gravity, self.dissipation)

    @property
    def lagrangian(self) -> Lagrangian:
        """The textbook L(q, qd) = ½ qdᵀ M(q) qd - V(q)."""
        return explicit.lagrangian(self.closed_form)

    @property
    def energies(self) -> LagrangianSystem:
        """The energies as a `LagrangianSystem`, for `dynamics` and `flow`."""
        return LagrangianSystem(self.lagrangian, self.dissipation)


def textbook(
    name: str,
    joints: tuple[JointKind, ...],
    mass_matrix: Callable[[Array], Array],
    coriolis: Callable[[Array, Array], Array],
    potential: Potential | None,
    gravity: Potential | None,
    tip: Callable[[Array], Array] | None,
    *,
    friction: float = 0.0,
    actuation: tuple[tuple[float, ...], ...] | None = None,
) -> Scene:
    """Builds a scene from its equations, friction and actuation.

    Friction is viscous, D = ½ b |qd|² with the torque b qd; there is none if b (N m s or N s/m) is zero. Without a
    potential, `gravity` is not used.
    """
    needs = Needs(joints, gravity=potential is not None, friction=friction != 0, actuation=actuation)
    force = gravity if needs.gravity else None
    dissipation = (lambda q, qd: 0.5 * friction * jnp.sum(qd**2)) if needs.friction else None
    return Scene(name, needs, mass_matrix, coriolis, potential, force, dissipation, tip)


def closed_form_forward_dynamics(scene: Scene, q: Vector, qd: Vector, tau: Vector) -> Vector:
    """Returns the acceleration qdd [d] by textbook formulas and LAPACK, on which the last digits of datasets depend."""
    bias = dynamics(scene.closed_form).inverse_dynamics(q, qd, jnp.zeros_like(qd))
    return jnp.linalg.solve(scene.mass_matrix(q), tau - bias)


def no_coriolis(q: Vector, qd: Vector) -> Vector:
    """Returns the Coriolis force of a constant mass matrix, zero."""
    return jnp.zeros_like(q)


def with_friction(
    scene: Scene,
    coefficients: FrictionCoefficients,
    shape: FrictionShape = FrictionShape(),  # noqa: B008
) -> Scene:
    """Adds friction to the joints of a scene, on top of existing friction.

    Dry friction is c tanh(u / v) with a small v, `shape.velocity_scale`: a joint "at rest" creeps more slowly than v.
    An explicit integrator is stable for steps below about 2.8 m v / c, where m is the smallest inertia at the joint.

    Args:
        scene: a scene with any joints.
        coefficients: viscous, coulomb and stribeck, one number per joint or one for all.
        shape: velocity scale and Stribeck velocity.

    Raises:
        InputError: there is no coefficient, or one belongs to another law or is negative.
    """
    present = {name: value for name, value in coefficients._asdict().items() if value is not None}
    if others := [name for name in present if name not in LAWS]:
        raise InputError(f"a scene has no {others[0]} friction; expected some of {', '.join(LAWS)}")
    dissipation = joint_dissipation(**present, **shape._asdict())
    if dissipation is None:
        raise InputError("all friction coefficients are zero; give a non-zero coefficient, or use the scene unchanged")
    laws = tuple(law for law in LAWS if law in present)
    needs = scene.needs._replace(joint_friction=laws)
    return scene._replace(needs=needs, dissipation=sum_of(scene.dissipation, dissipation))
