"""Masses in potential wells: the harmonic oscillator, and the Hénon-Heiles system with chaotic orbits."""

import jax.numpy as jnp

from dln_jax.scenes.scene import Scene, no_coriolis, viscous_dissipation
from dln_jax.types import Matrix, Needs, Scalar, Vector, require_positive


def mass_spring(*, mass: float = 1.0, stiffness: float = 1.0, friction: float = 0.0) -> Scene:
    """A mass on a spring: V = ½ k q², with q = 0 at rest; kg, N/m (zero for no spring) and N s/m."""
    require_positive(mass=mass)

    def mass_matrix(q: Vector) -> Matrix:
        return jnp.full((1, 1), mass, q.dtype)

    def potential(q: Vector) -> Scalar:
        return 0.5 * stiffness * jnp.sum(q**2)

    def gravity(q: Vector) -> Vector:
        return stiffness * q

    def tip(q: Vector) -> Vector:
        return jnp.array([q[0], 0.0])

    needs = Needs(joints=("prismatic",), gravity=stiffness != 0, friction=friction != 0)
    attraction = (potential, gravity) if stiffness else (None, None)
    return Scene("mass-spring", needs, mass_matrix, no_coriolis, *attraction, viscous_dissipation(friction), tip)


def henon_heiles(*, coupling: float = 1.0, friction: float = 0.0) -> Scene:
    """The Hénon-Heiles system, whose orbits are regular or chaotic depending on their energy.

        H = ½ (p₁² + p₂²) + ½ (x² + y²) + λ (x² y - y³/3)

    The well opens at the energy 1/(6 λ²): motions above it may escape to infinity in finite time. Source: Hénon and
    Heiles (1964), "The applicability of the third integral of motion".

    The coupling λ is in 1/m; mass 1 kg, linear stiffness 1 N/m; friction in N s/m.
    """

    def mass_matrix(q: Vector) -> Matrix:
        return jnp.eye(2, dtype=q.dtype)

    def potential(q: Vector) -> Scalar:
        x, y = q
        return 0.5 * (x**2 + y**2) + coupling * (x**2 * y - y**3 / 3)

    def gravity(q: Vector) -> Vector:
        x, y = q
        return jnp.array([x + 2 * coupling * x * y, y + coupling * (x**2 - y**2)])

    needs = Needs(joints=("prismatic", "prismatic"), friction=friction != 0)
    return Scene(
        "henon-heiles", needs, mass_matrix, no_coriolis, potential, gravity, viscous_dissipation(friction), lambda q: q
    )
