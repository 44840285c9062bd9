"""The Hénon-Heiles system: a unit mass in a plane, whose orbits are regular or chaotic by their energy
(Hénon and Heiles 1964, "The applicability of the third integral of motion").

    H = ½ (p₁² + p₂²) + ½ (x² + y²) + λ (x² y - y³/3)

The well opens at the energy 1/(6 λ²): motions above it may escape to infinity in finite time.
"""

import jax.numpy as jnp

from dln_jax.scenes.scene import Scene, viscous_dissipation
from dln_jax.types import Matrix, Needs, Scalar, Vector


def henon_heiles(*, coupling: float = 1.0, friction: float = 0.0) -> Scene:
    """The system with coupling λ, in 1/m; mass 1 kg, linear stiffness 1 N/m; friction in N s/m."""

    def mass_matrix(q: Vector) -> Matrix:
        return jnp.eye(2, dtype=q.dtype)

    def coriolis(q: Vector, qd: Vector) -> Vector:
        return jnp.zeros_like(q)

    def potential(q: Vector) -> Scalar:
        x, y = q
        return 0.5 * (x**2 + y**2) + coupling * (x**2 * y - y**3 / 3)

    def gravity(q: Vector) -> Vector:
        x, y = q
        return jnp.array([x + 2 * coupling * x * y, y + coupling * (x**2 - y**2)])

    return Scene(
        name="henon-heiles",
        needs=Needs(joints=("prismatic", "prismatic"), friction=friction != 0),
        mass_matrix=mass_matrix,
        coriolis=coriolis,
        potential=potential,
        gravity=gravity,
        dissipation=viscous_dissipation(friction),
        tip=lambda q: q,
    )
