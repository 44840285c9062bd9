"""Rotary pendulum (Furuta et al. 1992): a driven arm turns about the vertical and carries a free pole at its end."""

import jax.numpy as jnp

from dln_jax.scenes.scene import Scene, viscous_dissipation
from dln_jax.types import Matrix, Needs, Scalar, Vector


def rotary_pendulum(
    *,
    arm_mass: float = 0.095,
    arm_length: float = 0.085,
    pole_mass: float = 0.024,
    pole_length: float = 0.129,
    acceleration: float = 9.81,
    friction: float = 0.0,
) -> Scene:
    """The rotary pendulum with q = (arm angle, pole angle from upright); kg, m, m/s² and N m s.

    Arm and pole are uniform rods. Only the arm is driven: tau = B u with B = (1, 0)ᵀ. The dimensions are those of a
    common desktop plant.
    """
    centre = pole_length / 2
    about_hinge = pole_mass * pole_length**2 / 3
    arm_inertia = arm_mass * arm_length**2 / 3 + pole_mass * arm_length**2
    coupling = pole_mass * arm_length * centre
    weight = pole_mass * acceleration * centre

    def mass_matrix(q: Vector) -> Matrix:
        off_diagonal = coupling * jnp.cos(q[1])
        return jnp.array([[arm_inertia + about_hinge * jnp.sin(q[1]) ** 2, off_diagonal], [off_diagonal, about_hinge]])

    def coriolis(q: Vector, qd: Vector) -> Vector:
        turning = about_hinge * jnp.sin(2 * q[1])
        return jnp.array([turning * qd[0] * qd[1] - coupling * jnp.sin(q[1]) * qd[1] ** 2, -0.5 * turning * qd[0] ** 2])

    def potential(q: Vector) -> Scalar:
        return weight * jnp.cos(q[1])

    def gravity(q: Vector) -> Vector:
        return jnp.array([0.0, -weight * jnp.sin(q[1])])

    def tip(q: Vector) -> Vector:
        return pole_length * jnp.array([jnp.sin(q[1]), jnp.cos(q[1])])

    needs = Needs(joints=("revolute", "revolute"), friction=friction != 0, actuation=((1.0,), (0.0,)))
    dissipation = viscous_dissipation(friction)
    return Scene("rotary-pendulum", needs, mass_matrix, coriolis, potential, gravity, dissipation, tip)
