"""Cart-pole: a driven cart on a rail with a free pole; prismatic and revolute joints, under-actuated."""

import jax.numpy as jnp

from dln_jax.scenes.scene import Scene, viscous_dissipation
from dln_jax.types import Matrix, Needs, Scalar, Vector


def cart_pole(
    *,
    cart_mass: float = 1.0,
    pole_mass: float = 0.1,
    length: float = 0.5,
    acceleration: float = 9.81,
    friction: float = 0.0,
) -> Scene:
    """The cart-pole with q = (cart position, pole angle from upright); kg, m, m/s², N s/m and N m s.

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

    needs = Needs(joints=("prismatic", "revolute"), friction=friction != 0, actuation=((1.0,), (0.0,)))
    return Scene("cart-pole", needs, mass_matrix, coriolis, potential, gravity, viscous_dissipation(friction), tip)
