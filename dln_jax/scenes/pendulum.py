"""Pendulum: a point mass on a massless rod."""

import jax.numpy as jnp

from dln_jax.scenes.scene import Scene, no_coriolis, viscous_dissipation
from dln_jax.types import Matrix, Needs, Scalar, Vector


def pendulum(*, mass: float = 1.0, length: float = 1.0, acceleration: float = 9.81, friction: float = 0.0) -> Scene:
    """The pendulum with q = 0 hanging; kg, m, m/s² (zero for no gravity) and N m s."""
    weight = mass * acceleration * length

    def mass_matrix(q: Vector) -> Matrix:
        return jnp.full((1, 1), mass * length**2, q.dtype)

    def potential(q: Vector) -> Scalar:
        return weight * (1 - jnp.cos(q[0]))

    def gravity(q: Vector) -> Vector:
        return weight * jnp.sin(q)

    def tip(q: Vector) -> Vector:
        return length * jnp.array([jnp.sin(q[0]), -jnp.cos(q[0])])

    needs = Needs(joints=("revolute",), gravity=weight != 0, friction=friction != 0)
    attraction = (potential, gravity) if weight else (None, None)
    return Scene("pendulum", needs, mass_matrix, no_coriolis, *attraction, viscous_dissipation(friction), tip)
