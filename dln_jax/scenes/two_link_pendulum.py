"""Two-link pendulum in relative angles with one motor: the acrobot (elbow) and the pendubot (shoulder)."""

from typing import Literal, NamedTuple

import jax.numpy as jnp

from dln_jax.scenes.scene import Scene, viscous_dissipation
from dln_jax.types import Matrix, Needs, Scalar, Vector


class Links(NamedTuple):
    """Parameters of the inner and the outer link."""

    masses: tuple[float, float] = (0.5234602302310271, 0.6255677234174437)
    """kg."""
    lengths: tuple[float, float] = (0.2, 0.3)
    """m."""
    centres: tuple[float, float] = (0.2, 0.25569305436052964)
    """m, from the joint."""
    inertias: tuple[float, float] = (0.031887199591513114, 0.05086984812807257)
    """kg m², about the joint."""


def two_link_pendulum(
    motor: Literal["elbow", "shoulder"] = "elbow",
    *,
    links: Links = Links(),  # noqa: B008
    acceleration: float = 9.81,
    friction: float = 0.0,
) -> Scene:
    """The acrobot or the pendubot with q = 0 hanging and q[1] relative to the first link; m/s² and N m s.

    The default links are those of design C.1, model 1.1, of the benchmark of Wiebe et al. (2022, "RealAIGym").
    """
    (m1, m2), (l1, l2), (r1, r2), (I1, I2) = links
    coupling = m2 * l1 * r2
    inner, outer = (m1 * r1 + m2 * l1) * acceleration, m2 * r2 * acceleration

    def mass_matrix(q: Vector) -> Matrix:
        c = coupling * jnp.cos(q[1])
        return jnp.array([[I1 + I2 + m2 * l1**2 + 2 * c, I2 + c], [I2 + c, jnp.full_like(c, I2)]])

    def coriolis(q: Vector, qd: Vector) -> Vector:
        s = coupling * jnp.sin(q[1])
        return jnp.array([-s * qd[1] * (2 * qd[0] + qd[1]), s * qd[0] ** 2])

    def potential(q: Vector) -> Scalar:
        return -inner * jnp.cos(q[0]) - outer * jnp.cos(q[0] + q[1])

    def gravity(q: Vector) -> Vector:
        both = outer * jnp.sin(q[0] + q[1])
        return jnp.array([inner * jnp.sin(q[0]) + both, both])

    def tip(q: Vector) -> Vector:
        both = q[0] + q[1]
        return jnp.array([l1 * jnp.sin(q[0]) + l2 * jnp.sin(both), -l1 * jnp.cos(q[0]) - l2 * jnp.cos(both)])

    name, actuation = {"elbow": ("acrobot", ((0.0,), (1.0,))), "shoulder": ("pendubot", ((1.0,), (0.0,)))}[motor]
    needs = Needs(joints=("revolute", "revolute"), friction=friction != 0, actuation=actuation)
    return Scene(name, needs, mass_matrix, coriolis, potential, gravity, viscous_dissipation(friction), tip)
