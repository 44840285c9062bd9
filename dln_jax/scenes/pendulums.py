"""Pendulums: single and double pendulums, two-link arms, chains of d rods, and poles on a driven base."""

from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from dln_jax.scenes.scene import Scene, no_coriolis, textbook
from dln_jax.types import InputError, JointKind, Matrix, Needs, Scalar, Vector

LINK_LENGTH = 1.0
"""Length of both links in m."""


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

    equations = mass_matrix, no_coriolis, potential if weight else None, gravity, tip
    return textbook("pendulum", ("revolute",), *equations, friction=friction)


def double_pendulum(
    *,
    masses: tuple[float, float] = (1.0, 1.0),
    lengths: tuple[float, float] = (1.0, 1.0),
    acceleration: float = 9.81,
    friction: float = 0.0,
) -> Scene:
    """Two point masses on massless rods, angles from the vertical, q = 0 hanging; in kg, m, m/s², N m s per joint."""
    carried = np.array([masses[0] + masses[1], masses[1]])
    rods = np.array(lengths)
    coupling = np.diag(carried * rods**2)
    coupling[0, 1] = coupling[1, 0] = masses[1] * rods[0] * rods[1]
    return _hanging("double-pendulum", coupling, carried * acceleration * rods, rods, friction=friction)


def _hanging(
    name: str,
    coupling: np.ndarray,
    weight: np.ndarray,
    lengths: np.ndarray,
    *,
    relative: bool = False,
    friction: float,
) -> Scene:
    """Returns a planar chain that hangs at q = 0, from its equations in the rods' angles θ from the vertical.

    Args:
        coupling: a in M_ij = a_ij cos(θ_i - θ_j), kg m².
        weight: torque that holds each rod horizontal, with everything attached to it, N m.
        lengths: lengths of the rods, m.
        relative: q holds the angles between neighbours: θ = S q = cumsum(q), M = Sᵀ M_θ S, and likewise for forces.
    """

    def same(x: Any) -> Any:
        return x

    to_angles, to_joints = (jnp.cumsum, _sum_outwards) if relative else (same, same)

    def mass_matrix(q: Vector) -> Matrix:
        angles = to_angles(q)
        return to_joints(to_joints(coupling * jnp.cos(angles[:, None] - angles)).T)

    def coriolis(q: Vector, qd: Vector) -> Vector:
        angles = to_angles(q)
        return to_joints((coupling * jnp.sin(angles[:, None] - angles)) @ to_angles(qd) ** 2)

    def potential(q: Vector) -> Scalar:
        return jnp.sum(weight * (1 - jnp.cos(to_angles(q))))

    def gravity(q: Vector) -> Vector:
        return to_joints(weight * jnp.sin(to_angles(q)))

    def tip(q: Vector) -> Vector:
        angles = to_angles(q)
        return jnp.array([lengths @ jnp.sin(angles), -lengths @ jnp.cos(angles)])

    joints = ("revolute",) * len(weight)
    return textbook(name, joints, mass_matrix, coriolis, potential, gravity, tip, friction=friction)


def two_link_arm(*, zero: Literal["horizontal", "hanging"] = "horizontal") -> Scene:
    """The frictionless plant of the published DeLaN experiments (Lutter et al. 2019), with q2 relative to link 1.

    `zero` is the posture at q = 0: "horizontal" as in all published data (gravity in cos q), or "hanging" as in most
    textbooks (gravity in sin q).
    """
    name = "two-link-arm" if zero == "horizontal" else "two-link-arm-hanging"
    inertias, weights = (1.3727291666666667, 0.5176145833333333, 0.5), (2.625, 1.5)
    return _two_links(name, inertias, weights, (LINK_LENGTH, LINK_LENGTH), hanging=zero == "hanging")


def _two_links(
    name: str,
    inertias: tuple[float, float, float],
    weights: tuple[float, float],
    lengths: tuple[float, float],
    *,
    hanging: bool,
    **options: Any,
) -> Scene:
    """Returns two links in a plane, q[1] relative to the first one.

    Args:
        inertias: M = [[a + 2 c cos q2, b + c cos q2], [b + c cos q2, b]] with these a, b and c, kg m².
        weights: torque that holds each link horizontal, N m; the first includes the second link.
        hanging: both links hang at q = 0; otherwise they are horizontal.
        options: friction and actuation, as for `textbook`.
    """
    shoulder_inertia, elbow_inertia, coupling = inertias
    # The conventions differ by a quarter turn.
    offset, rise, slope = (-jnp.pi / 2, lambda x: -jnp.cos(x), jnp.sin) if hanging else (0.0, jnp.sin, jnp.cos)

    def mass_matrix(q: Vector) -> Matrix:
        cosine = coupling * jnp.cos(q[1])
        across = elbow_inertia + cosine
        return jnp.array([[shoulder_inertia + 2 * cosine, across], [across, elbow_inertia]])

    def coriolis(q: Vector, qd: Vector) -> Vector:
        sine = coupling * jnp.sin(q[1])
        return jnp.array([-sine * (2 * qd[0] * qd[1] + qd[1] ** 2), sine * qd[0] ** 2])

    def potential(q: Vector) -> Scalar:
        return weights[0] * rise(q[0]) + weights[1] * rise(q[0] + q[1])

    def gravity(q: Vector) -> Vector:
        elbow = weights[1] * slope(q[0] + q[1])
        return jnp.array([weights[0] * slope(q[0]) + elbow, elbow])

    def tip(q: Vector) -> Vector:
        rods, angles = jnp.array(lengths), jnp.array([q[0], q[0] + q[1]]) + offset
        return jnp.array([rods @ jnp.cos(angles), rods @ jnp.sin(angles)])

    joints = ("revolute", "revolute")
    return textbook(name, joints, mass_matrix, coriolis, potential, gravity, tip, **options)


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

    The default links are design C.1, model 1.1, of the benchmark by Wiebe et al. (2022, "RealAIGym").
    """
    (m1, m2), (l1, l2), (r1, r2), (I1, I2) = links
    inertias = I1 + I2 + m2 * l1**2, I2, m2 * l1 * r2
    weights = (m1 * r1 + m2 * l1) * acceleration, m2 * r2 * acceleration
    name, actuation = {"elbow": ("acrobot", ((0.0,), (1.0,))), "shoulder": ("pendubot", ((1.0,), (0.0,)))}[motor]
    return _two_links(name, inertias, weights, (l1, l2), hanging=True, friction=friction, actuation=actuation)


def chain(
    d: int, *, mass: float = 1.0, length: float = 1.0, acceleration: float = 9.81, friction: float = 0.0
) -> Scene:
    """Planar chain of uniform rods, angles relative to the previous link, q = 0 hanging; kg, m per link, m/s², N m s.

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

    return _hanging(f"chain-{d}", coupling, weight, np.full(d, length), relative=True, friction=friction)


def _sum_outwards(forces):
    """Multiplies the rows by Sᵀ: a joint's torque is the sum over its own rod and all rods beyond it."""
    return jnp.cumsum(forces[::-1], axis=0)[::-1]


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

    def tip(q: Vector) -> Vector:
        return jnp.array([q[0] + length * jnp.sin(q[1]), length * jnp.cos(q[1])])

    return _driven_pole("cart-pole", "prismatic", mass_matrix, coriolis, weight, tip, friction)


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
    is driven: tau = B f with B = (1, 0, 0)ᵀ. Defaults as in Lutter et al. (CoRL 2019).

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
    dimensions are typical of a desktop plant.
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

    def tip(q: Vector) -> Vector:
        return pole_length * jnp.array([jnp.sin(q[1]), jnp.cos(q[1])])

    return _driven_pole("rotary-pendulum", "revolute", mass_matrix, coriolis, weight, tip, friction)


def _driven_pole(
    name: str, base: JointKind, mass_matrix: Any, coriolis: Any, weight: float, tip: Any, friction: float
) -> Scene:
    """Returns a driven base with a free pole, q[1] from upright; `weight` is the torque that holds the pole
    horizontal."""

    def potential(q: Vector) -> Scalar:
        return weight * jnp.cos(q[1])

    def gravity(q: Vector) -> Vector:
        return jnp.array([0.0, -weight * jnp.sin(q[1])])

    equations, actuation = (mass_matrix, coriolis, potential, gravity, tip), ((1.0,), (0.0,))
    return textbook(name, (base, "revolute"), *equations, friction=friction, actuation=actuation)
