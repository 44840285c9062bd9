"""A mass on a spring: the harmonic oscillator."""

import jax.numpy as jnp

from dln_jax.scenes.scene import Scene, viscous_dissipation
from dln_jax.types import Matrix, Needs, Scalar, Vector, require_positive


def mass_spring(*, mass: float = 1.0, stiffness: float = 1.0, friction: float = 0.0) -> Scene:
    """V = ½ k q², with q = 0 at rest; kg, N/m (zero for no spring) and N s/m."""
    require_positive(mass=mass)

    def mass_matrix(q: Vector) -> Matrix:
        return jnp.full((1, 1), mass, q.dtype)

    def coriolis(q: Vector, qd: Vector) -> Vector:
        return jnp.zeros_like(q)

    def potential(q: Vector) -> Scalar:
        return 0.5 * stiffness * jnp.sum(q**2)

    def gravity(q: Vector) -> Vector:
        return stiffness * q

    return Scene(
        name="mass-spring",
        needs=Needs(joints=("prismatic",), gravity=stiffness != 0, friction=friction != 0),
        mass_matrix=mass_matrix,
        coriolis=coriolis,
        potential=potential if stiffness else None,
        gravity=gravity if stiffness else None,
        dissipation=viscous_dissipation(friction),
        tip=lambda q: jnp.array([q[0], 0.0]),
    )
