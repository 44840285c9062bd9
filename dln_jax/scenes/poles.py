"""Poles on a driven base, under-actuated: the cart-pole, a flexible one, and the rotary pendulum."""

import jax.numpy as jnp

from dln_jax.scenes.scene import Scene, textbook
from dln_jax.types import Matrix, Needs, Scalar, Vector


def cart_pole(
    *,
    cart_mass: float = 1.0,
    pole_mass: float = 0.1,
    length: float = 0.5,
    acceleration: float = 9.81,
    friction: float = 0.0,
) -> Scene:
    """A driven cart with a free pole, q = (cart position, pole angle from upright); in kg, m, m/s², N s/m and N m s.

    The pole is a point mass at `length` from its hinge. Only the cart is driven: tau = B f with B = (1, 0)ᵀ.
    """
    coupling = pole_mass * length
    weight = coupling * acceleration

    def mass_matrix(q: Vector) -> Matrix:
        off_diagonal = coupling * jnp.cos(q[1])
        return jnp.array([[cart_mass + pole_mass, off_diagonal], [off_diagonal, pole_mass * length**2]])

    def coriolis(q: Vector, qd: Vector) -> Vector:
        return jnp.array([-coupling * jnp.sin(q[1]) * qd[1] ** 2, 0.0])

    def potential(q: Vector) -> Scalar:
        return weight * jnp.cos(q[1])

    def gravity(q: Vector) -> Vector:
        return jnp.array([0.0, -weight * jnp.sin(q[1])])

    def tip(q: Vector) -> Vector:
        return jnp.array([q[0] + length * jnp.sin(q[1]), length * jnp.cos(q[1])])

    equations = mass_matrix, coriolis, potential, gravity, tip
    return textbook("cart-pole", ("prismatic", "revolute"), *equations, friction=friction, actuation=((1.0,), (0.0,)))


def flexible_cart_pole(
    *,
    driven_mass: float = 0.57,
    carried_mass: float = 0.375,
    pole_mass: float = 0.127,
    length: float = 0.1778,
    stiffness: float = 200.0,
    acceleration: float = 9.81,
    friction: tuple[float, float, float] = (0.5, 0.5, 0.0024),
) -> Scene:
    """A cart pulls a second one by a spring, q = (driven cart, extension of the spring, pole angle from upright).

    The second cart is at q[0] + q[1]; it carries the pole, a point mass at `length` from its hinge. Only the first cart
    is driven: tau = B f with B = (1, 0, 0)ᵀ. Defaults are those of Lutter et al. (CoRL 2019).

    Args:
        driven_mass: mass of the driven cart, kg.
        carried_mass: mass of the second cart, kg.
        pole_mass: mass of the pole, kg.
        length: distance of the pole's mass from its hinge, m.
        stiffness: stiffness of the spring, N/m.
        acceleration: m/s².
        friction: viscous friction of the two carts on the rail, N s/m, and of the hinge, N m s.
    """
    coupling = pole_mass * length
    weight = coupling * acceleration
    beyond = carried_mass + pole_mass

    def mass_matrix(q: Vector) -> Matrix:
        across = coupling * jnp.cos(q[2])
        return jnp.array(
            [[driven_mass + beyond, beyond, across], [beyond, beyond, across], [across, across, pole_mass * length**2]]
        )

    def coriolis(q: Vector, qd: Vector) -> Vector:
        pull = -coupling * jnp.sin(q[2]) * qd[2] ** 2
        return jnp.array([pull, pull, 0.0])

    def potential(q: Vector) -> Scalar:
        return 0.5 * stiffness * q[1] ** 2 + weight * jnp.cos(q[2])

    def gravity(q: Vector) -> Vector:
        return jnp.array([0.0, stiffness * q[1], -weight * jnp.sin(q[2])])

    def dissipation(q: Vector, qd: Vector) -> Scalar:
        first, second, hinge = friction
        return 0.5 * (first * qd[0] ** 2 + second * (qd[0] + qd[1]) ** 2 + hinge * qd[2] ** 2)

    def tip(q: Vector) -> Vector:
        return jnp.array([q[0] + q[1] + length * jnp.sin(q[2]), length * jnp.cos(q[2])])

    joints, damped = ("prismatic", "prismatic", "revolute"), dissipation if any(friction) else None
    needs = Needs(joints=joints, friction=any(friction), actuation=((1.0,), (0.0,), (0.0,)))
    return Scene("flexible-cart-pole", needs, mass_matrix, coriolis, potential, gravity, damped, tip)


def rotary_pendulum(
    *,
    arm_mass: float = 0.095,
    arm_length: float = 0.085,
    pole_mass: float = 0.024,
    pole_length: float = 0.129,
    acceleration: float = 9.81,
    friction: float = 0.0,
) -> Scene:
    """An arm about the vertical carries a free pole, q = (arm angle, pole angle from upright); kg, m, m/s², N m s.

    After Furuta et al. (1992). Arm and pole are uniform rods. Only the arm is driven: tau = B u with B = (1, 0)ᵀ. The
    dimensions are those of a common desktop plant.
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

    equations, actuation = (mass_matrix, coriolis, potential, gravity, tip), ((1.0,), (0.0,))
    return textbook("rotary-pendulum", ("revolute", "revolute"), *equations, friction=friction, actuation=actuation)
