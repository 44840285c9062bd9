"""Planar two-link arm without friction: the plant of the published DeLaN experiments (Lutter et al. 2019)."""

from typing import Literal

import jax.numpy as jnp

from dln_jax.scenes.scene import Scene
from dln_jax.types import Matrix, Needs, Scalar, Vector

LINK_LENGTH = 1.0
"""m, of both links."""

# Inertial and gravity constants of the published plant, kg m² and N m.
_SHOULDER_INERTIA = 1.3727291666666667
_ELBOW_INERTIA = 0.5176145833333333
_COUPLING = 0.5
_SHOULDER_WEIGHT = 2.625
_ELBOW_WEIGHT = 1.5


def two_link_arm(*, zero: Literal["horizontal", "hanging"] = "horizontal") -> Scene:
    """The arm with q2 relative to link 1.

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

    needs = Needs(joints=("revolute", "revolute"))
    return Scene(name, needs, mass_matrix, coriolis, potential, gravity, tip=tip)


def joint_angles(tip: Vector) -> Vector:
    """Inverse kinematics: q [2] with the elbow bent counter-clockwise (q2 > 0), for a tip [2] in m.

    Angle zero is horizontal. A tip out of reach gives NaN.
    """
    x, y = tip
    cosine = (x**2 + y**2) / (2 * LINK_LENGTH**2) - 1
    elbow = jnp.arccos(cosine)
    shoulder = jnp.arctan2(y, x) - jnp.arctan2(jnp.sin(elbow), 1 + cosine)
    return jnp.array([shoulder, elbow])
