"""Pendulums in the plane: a single and a double one, the arm and the robots of two links, and a chain of d rods."""

from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from dln_jax.scenes.scene import Scene, no_coriolis, textbook
from dln_jax.types import InputError, Matrix, Scalar, Vector

LINK_LENGTH = 1.0
"""Length of both links in m."""

# Inertial and gravity constants of the published plant, kg m² and N m.
_SHOULDER_INERTIA = 1.3727291666666667
_ELBOW_INERTIA = 0.5176145833333333
_COUPLING = 0.5
_SHOULDER_WEIGHT = 2.625
_ELBOW_WEIGHT = 1.5


def pendulum(*, mass: float = 1.0, length: float = 1.0, acceleration: float = 9.81, friction: float = 0.0) -> Scene:
    """The pendulum with q = 0 hanging; in kg, m, m/s² (zero for no gravity) and N m s."""
    weight = mass * acceleration * length

    def mass_matrix(q: Vector) -> Matrix:
        return jnp.full((1, 1), mass * length**2, q.dtype)

    def potential(q: Vector) -> Scalar:
        return weight * (1 - jnp.cos(q[0]))

    def gravity(q: Vector) -> Vector:
        return weight * jnp.sin(q)

    def tip(q: Vector) -> Vector:
        return length * jnp.array([jnp.sin(q[0]), -jnp.cos(q[0])])

    attraction = (potential, gravity) if weight else (None, None)
    return textbook("pendulum", ("revolute",), mass_matrix, no_coriolis, *attraction, tip, friction=friction)


def double_pendulum(
    *,
    masses: tuple[float, float] = (1.0, 1.0),
    lengths: tuple[float, float] = (1.0, 1.0),
    acceleration: float = 9.81,
    friction: float = 0.0,
) -> Scene:
    """Two point masses on massless rods, angles from the vertical, q = 0 hanging; in kg, m, m/s², N m s per joint."""
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

    joints = ("revolute", "revolute")
    return textbook("double-pendulum", joints, mass_matrix, coriolis, potential, gravity, tip, friction=friction)


def two_link_arm(*, zero: Literal["horizontal", "hanging"] = "horizontal") -> Scene:
    """The frictionless plant of the published DeLaN experiments (Lutter et al. 2019), with q2 relative to link 1.

    `zero` is the posture at q = 0, which sets the gravity convention: "horizontal" is that of all published data
    (gravity in cos q), "hanging" that of most textbooks (gravity in sin q).
    """
    # The conventions differ by a quarter turn.
    if zero == "horizontal":
        name, offset, rise, slope = "two-link-arm", 0.0, jnp.sin, jnp.cos
    else:
        name, offset, rise, slope = "two-link-arm-hanging", -jnp.pi / 2, lambda angle: -jnp.cos(angle), jnp.sin

    def mass_matrix(q: Vector) -> Matrix:
        cosine = jnp.cos(q[1])
        shoulder = _SHOULDER_INERTIA + 2 * _COUPLING * cosine
        coupling = _ELBOW_INERTIA + _COUPLING * cosine
        return jnp.array([[shoulder, coupling], [coupling, _ELBOW_INERTIA]])

    def coriolis(q: Vector, qd: Vector) -> Vector:
        sine = _COUPLING * jnp.sin(q[1])
        return jnp.array([-sine * (2 * qd[0] * qd[1] + qd[1] ** 2), sine * qd[0] ** 2])

    def potential(q: Vector) -> Scalar:
        return _SHOULDER_WEIGHT * rise(q[0]) + _ELBOW_WEIGHT * rise(q[0] + q[1])

    def gravity(q: Vector) -> Vector:
        elbow = _ELBOW_WEIGHT * slope(q[0] + q[1])
        return jnp.array([_SHOULDER_WEIGHT * slope(q[0]) + elbow, elbow])

    def tip(q: Vector) -> Vector:
        angles = jnp.array([q[0], q[0] + q[1]]) + offset
        return LINK_LENGTH * jnp.array([jnp.sum(jnp.cos(angles)), jnp.sum(jnp.sin(angles))])

    return textbook(name, ("revolute", "revolute"), mass_matrix, coriolis, potential, gravity, tip)


def joint_angles(tip: Vector) -> Vector:
    """Inverse kinematics: returns q [2] with the elbow bent counter-clockwise (q2 > 0), for a tip [2] in m.

    Angle zero is horizontal. A tip out of reach gives NaN.
    """
    x, y = tip
    cosine = (x**2 + y**2) / (2 * LINK_LENGTH**2) - 1
    elbow = jnp.arccos(cosine)
    shoulder = jnp.arctan2(y, x) - jnp.arctan2(jnp.sin(elbow), 1 + cosine)
    return jnp.array([shoulder, elbow])


class Links(NamedTuple):
    """Parameters of the inner and the outer link."""

    masses: tuple[float, float] = (0.5234602302310271, 0.6255677234174437)
    """In kg."""
    lengths: tuple[float, float] = (0.2, 0.3)
    """In m."""
    centres: tuple[float, float] = (0.2, 0.25569305436052964)
    """Distances of the centres of mass from the joints, in m."""
    inertias: tuple[float, float] = (0.031887199591513114, 0.05086984812807257)
    """About the joints, in kg m²."""


def two_link_pendulum(
    motor: Literal["elbow", "shoulder"] = "elbow",
    *,
    links: Links = Links(),  # noqa: B008
    acceleration: float = 9.81,
    friction: float = 0.0,
) -> Scene:
    """The acrobot or the pendubot with q = 0 hanging and q[1] relative to the first link; in m/s² and N m s.

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
    equations = mass_matrix, coriolis, potential, gravity, tip
    return textbook(name, ("revolute", "revolute"), *equations, friction=friction, actuation=actuation)


def chain(
    d: int, *, mass: float = 1.0, length: float = 1.0, acceleration: float = 9.81, friction: float = 0.0
) -> Scene:
    """Planar chain of uniform rods, angles relative to the previous link, q = 0 hanging; kg, m per link, m/s², N m s.

    In absolute angles θ = cumsum(q) the equations are short (a_ij cos(θ_i - θ_j) couples rods i and j). The constant
    matrix S of the sum transforms them to joint coordinates: M = Sᵀ M_θ S, and likewise for forces.

    Raises:
        InputError: d < 1.
    """
    if d < 1:
        raise InputError(f"chain: d = {d} links; give at least 1")
    outer_rods = np.arange(d - 1, -1, -1.0)  # number of rods below each rod
    farther = np.minimum(outer_rods[:, None], outer_rods[None, :])
    coupling = mass * length**2 * (farther + 0.5)
    np.fill_diagonal(coupling, mass * length**2 * (outer_rods + 1 / 3))
    weight = mass * acceleration * length * (outer_rods + 0.5)

    def mass_matrix(q: Vector) -> Matrix:
        angles = jnp.cumsum(q)
        return _sum_outwards(_sum_outwards(coupling * jnp.cos(angles[:, None] - angles)).T)

    def coriolis(q: Vector, qd: Vector) -> Vector:
        angles, rates = jnp.cumsum(q), jnp.cumsum(qd)
        return _sum_outwards((coupling * jnp.sin(angles[:, None] - angles)) @ rates**2)

    def potential(q: Vector) -> Scalar:
        return jnp.sum(weight * (1 - jnp.cos(jnp.cumsum(q))))

    def gravity(q: Vector) -> Vector:
        return _sum_outwards(weight * jnp.sin(jnp.cumsum(q)))

    def tip(q: Vector) -> Vector:
        angles = jnp.cumsum(q)
        return length * jnp.array([jnp.sum(jnp.sin(angles)), -jnp.sum(jnp.cos(angles))])

    joints = ("revolute",) * d
    return textbook(f"chain-{d}", joints, mass_matrix, coriolis, potential, gravity, tip, friction=friction)


def _sum_outwards(forces):
    """Multiplies the rows by Sᵀ: a joint's torque is the sum over its own rod and all rods beyond it."""
    return jnp.cumsum(forces[::-1], axis=0)[::-1]
