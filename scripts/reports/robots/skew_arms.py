"""Two arms of our own design, in which hardly any two axes meet at right angles, with round numbers in SI units."""

import numpy as np

from dln_jax.mechanics.trees.description import dh_frames, serial
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.scenes.datasets.robot_arms import Arm


def skew_arm() -> Arm:
    """Seven revolute joints on a tilted base, no two neighbours parallel or perpendicular."""
    rows = [  # alpha, a, d, theta
        [0.35, 0.0, 0.3, 0.4], [-1.1, 0.05, 0.1, 0.2], [0.8, 0.12, 0.3, -0.5], [1.25, 0.25, -0.05, 0.3],
        [-0.6, 0.1, 0.28, 0.0], [1.0, -0.06, 0.08, 0.7], [-1.3, 0.07, 0.1, -0.2],
    ]  # fmt: skip
    return Arm(
        "skew-arm",
        serial(*dh_frames(rows), _links(7), armature=np.linspace(0.2, 0.02, 7)),
        viscous=np.linspace(0.3, 0.05, 7),
        coulomb=np.linspace(0.6, 0.1, 7),
        offset=np.array([0.1, -0.15, 0.05, 0.1, -0.05, 0.03, 0.02]),
        limits=np.tile([-2.5, 2.5], (7, 1)),
        rates=np.array([2.0, 2.0, 2.2, 2.2, 2.6, 2.6, 2.6]),
        accelerations=np.array([10.0, 8.0, 10.0, 12.0, 15.0, 20.0, 20.0]),
    )


def sliding_arm() -> Arm:
    """Six joints, the third prismatic; the first two are not perpendicular, the last four are skew."""
    rows = [
        [0.2, 0.0, 0.4, 0.0], [-1.3, 0.1, 0.0, 0.3], [1.0, 0.05, 0.2, 0.2],
        [0.7, 0.15, 0.1, -0.4], [-1.2, 0.1, 0.25, 0.0], [0.9, 0.05, 0.1, 0.5],
    ]  # fmt: skip
    kinds = ["revolute", "revolute", "prismatic", "revolute", "revolute", "revolute"]
    return Arm(
        "sliding-arm",
        serial(*dh_frames(rows), _links(6), joints=kinds, armature=np.array([0.2, 0.2, 1.0, 0.1, 0.05, 0.03])),
        viscous=np.array([0.3, 0.3, 5.0, 0.2, 0.1, 0.05]),
        coulomb=np.array([0.6, 0.5, 4.0, 0.4, 0.2, 0.1]),
        offset=np.array([0.1, -0.15, 0.5, 0.1, -0.05, 0.03]),
        limits=np.array([[-2.5, 2.5]] * 2 + [[-0.4, 0.4]] + [[-2.5, 2.5]] * 3),
        rates=np.array([2.0, 2.0, 0.8, 2.2, 2.6, 2.6]),
        accelerations=np.array([10.0, 8.0, 4.0, 12.0, 15.0, 20.0]),
    )


def _links(d: int) -> list[np.ndarray]:
    """Physically consistent, asymmetric bodies, from 4 kg at the base to some 0.5 kg at the tip."""
    links = []
    for link in range(d):
        mass = 4.0 * 0.72**link
        centre = 0.12 * np.array([np.sin(1.0 + 2 * link), np.cos(2.0 + 3 * link), np.sin(3.0 + link)])
        size = 0.1 + 0.02 * np.array([np.cos(link), np.sin(2 * link), np.cos(3 * link)])
        turn, _ = np.linalg.qr(np.cos(np.arange(9.0) * (link + 1)).reshape(3, 3) + 2 * np.eye(3))
        moments = mass / 3 * (size @ size * np.eye(3) - np.diag(size**2))
        links.append(inertial_parameters(mass, centre, turn @ moments @ turn.T))
    return links
