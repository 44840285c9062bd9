"""Double pendulum: two point masses on massless rods, both angles measured from the vertical."""

import jax.numpy as jnp

from dln_jax.scenes.scene import Scene, viscous_dissipation
from dln_jax.types import Matrix, Needs, Scalar, Vector


def double_pendulum(
    *,
    masses: tuple[float, float] = (1.0, 1.0),
    lengths: tuple[float, float] = (1.0, 1.0),
    acceleration: float = 9.81,
    friction: float = 0.0,
) -> Scene:
    """The double pendulum with q = 0 hanging; kg, m, m/s² and N m s (friction at both angles)."""
    inner, outer = lengths
    total = masses[0] + masses[1]
    coupling = masses[1] * inner * outer
    inner_weight = total * acceleration * inner
    outer_weight = masses[1] * acceleration * outer

    def mass_matrix(q: Vector) -> Matrix:
        off_diagonal = coupling * jnp.cos(q[0] - q[1])
        return jnp.array([[total * inner**2, off_diagonal], [off_diagonal, masses[1] * outer**2]])

    def coriolis(q: Vector, qd: Vector) -> Vector:
        sine = coupling * jnp.sin(q[0] - q[1])
        return jnp.array([sine * qd[1] ** 2, -sine * qd[0] ** 2])

    def potential(q: Vector) -> Scalar:
        return inner_weight * (1 - jnp.cos(q[0])) + outer_weight * (1 - jnp.cos(q[1]))

    def gravity(q: Vector) -> Vector:
        return jnp.array([inner_weight, outer_weight]) * jnp.sin(q)

    def tip(q: Vector) -> Vector:
        rods = jnp.array(lengths)
        return jnp.array([rods @ jnp.sin(q), -rods @ jnp.cos(q)])

    needs = Needs(joints=("revolute", "revolute"), friction=friction != 0)
    return Scene(
        "double-pendulum", needs, mass_matrix, coriolis, potential, gravity, viscous_dissipation(friction), tip
    )
