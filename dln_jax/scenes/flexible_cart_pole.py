"""Flexible cart-pole: a driven cart pulls a second cart with a free pole by a spring (Lutter et al., CoRL 2019)."""

import jax.numpy as jnp

from dln_jax.scenes.scene import Scene
from dln_jax.types import Matrix, Needs, Scalar, Vector


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
    """The flexible cart-pole with q = (driven cart, extension of the spring, pole angle from upright).

    The second cart is at q[0] + q[1]; it carries the pole, a point mass at `length` from its hinge. Only the first cart
    is driven: tau = B f with B = (1, 0, 0)ᵀ. Defaults are the paper's values.

    Args:
        driven_mass: kg.
        carried_mass: mass of the second cart, kg.
        pole_mass: kg.
        length: m.
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

    joints = ("prismatic", "prismatic", "revolute")
    needs = Needs(joints=joints, friction=any(friction), actuation=((1.0,), (0.0,), (0.0,)))
    damped = dissipation if any(friction) else None
    return Scene("flexible-cart-pole", needs, mass_matrix, coriolis, potential, gravity, damped, tip)
