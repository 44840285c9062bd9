"""Simulated robot arms, sum-of-sines motions and their torques: the protocol of the LIP paper.

Giacomuzzo, Carli, Romeres and Dalla Libera, T-RO 2024 (arXiv 2310.06585; merlresearch/LIP4RobotInverseDynamics): 50 s,
torque noise of 0.01 N m, seed 0 for training and 101 to 150 for the test; every tenth of 5,001 samples is fitted.

`skew_arm` and `sliding_arm` are our own designs, in which hardly any two axes meet at right angles, with round numbers
in SI units. The Franka Panda has masses and centres after Gaz et al. (RA-L 2019). That paper's moments are taken
about the links' frames, so some links are not physically consistent, which does not matter for comparing models that do
not know the kinematics.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.trees.description import Tree, dh_frames, serial, with_payload
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.mechanics.trees.recursions import newton_euler
from dln_jax.precision import in_float64

RIGHT = np.pi / 2
ROWS = [  # alpha, a, d, theta
    [0, 0, 0.333, 0], [-RIGHT, 0, 0, 0], [RIGHT, 0, 0.316, 0], [RIGHT, 0.0825, 0, 0],
    [-RIGHT, -0.0825, 0.384, 0], [RIGHT, 0, 0, 0], [RIGHT, 0.088, 0, 0],
]  # fmt: skip
MASSES = [4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522]
CENTRES = [
    [3.875e-3, 2.081e-3, -0.175], [-3.141e-3, -2.872e-2, 3.495e-3], [2.7518e-2, 3.9252e-2, -6.6502e-2],
    [-5.317e-2, 1.04419e-1, 2.7454e-2], [-1.1953e-2, 4.1065e-2, -3.8437e-2], [6.0149e-2, -1.4117e-2, -1.0517e-2],
    [1.0517e-2, -4.252e-3, 6.1597e-2],
]  # fmt: skip
MOMENTS = [
    [0.70337, -1.39e-4, 6.772e-3, 0.70661, 1.9169e-2, 9.117e-3],
    [7.962e-3, -3.925e-3, 1.0254e-2, 2.811e-2, 7.04e-4, 2.5995e-2],
    [3.7242e-2, -4.761e-3, -1.1396e-2, 3.6155e-2, -1.2805e-2, 1.083e-2],
    [2.5853e-2, 7.796e-3, -1.332e-3, 1.9552e-2, 8.641e-3, 2.8323e-2],
    [3.5549e-2, -2.117e-3, -4.037e-3, 2.9474e-2, 2.29e-4, 8.627e-3],
    [1.964e-3, 1.09e-4, -1.158e-3, 4.354e-3, 3.41e-4, 5.433e-3],
    [1.2516e-2, -4.28e-4, -1.196e-3, 1.0027e-2, -7.41e-4, 4.815e-3],
]
LIMITS = np.array([[-2.9, 2.9], [-1.8, 1.8], [-2.9, 2.9], [-3.0, 0.0], [-2.9, 2.9], [0.0, 3.8], [-2.9, 2.9]])
"""The Panda: modified Denavit-Hartenberg rows, masses in kg, centres in m, moments in kg m², limits in rad."""
SINES = 50


class Arm(NamedTuple):
    """A tree of d joints, their friction, and limits of position, velocity and acceleration; SI units."""

    tree: Tree
    viscous: Float[np.ndarray, " d"]
    coulomb: Float[np.ndarray, " d"]
    offset: Float[np.ndarray, " d"]
    limits: Float[np.ndarray, "d 2"]
    rates: Float[np.ndarray, " d"]
    accelerations: Float[np.ndarray, " d"]


def panda(active: int = 7) -> Arm:
    """The Panda with its first `active` joints moving and the others locked at the middle of their limits."""
    rotations, positions = dh_frames(ROWS)
    inertias = [np.array([m, *np.multiply(m, c), *i]) for m, c, i in zip(MASSES, CENTRES, MOMENTS, strict=True)]
    tree = serial(rotations[:active], positions[:active], inertias[:active])
    rotation, position = np.eye(3), np.zeros(3)
    for link in range(active, 7):
        # Frame of the locked link relative to the last one that moves.
        c, s = np.cos(LIMITS[link].mean()), np.sin(LIMITS[link].mean())
        position = position + rotation @ positions[link]
        rotation = rotation @ rotations[link] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        tree = with_payload(tree, active - 1, inertias[link], rotation=rotation, position=position)
    return Arm(
        tree,
        viscous=np.array([0.0628, 0.2088, 0.0361, 0.2174, 0.1021, 0.0001, 0.0632])[:active],
        coulomb=np.array([0.2549, 0.1413, 0.1879, 0.3625, 0.2728, 0.1529, 0.2097])[:active],
        offset=np.array([-0.1069, -0.1601, -0.0718, -0.2562, 0.0079, 0.0935, -0.0070])[:active],
        limits=LIMITS[:active],
        rates=np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])[:active],
        accelerations=np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])[:active],
    )


def skew_arm() -> Arm:
    """Seven revolute joints on a tilted base, no two neighbours parallel or perpendicular."""
    rows = [  # alpha, a, d, theta
        [0.35, 0.0, 0.3, 0.4], [-1.1, 0.05, 0.1, 0.2], [0.8, 0.12, 0.3, -0.5], [1.25, 0.25, -0.05, 0.3],
        [-0.6, 0.1, 0.28, 0.0], [1.0, -0.06, 0.08, 0.7], [-1.3, 0.07, 0.1, -0.2],
    ]  # fmt: skip
    return Arm(
        serial(*dh_frames(rows), links(7), armature=np.linspace(0.2, 0.02, 7)),
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
        serial(*dh_frames(rows), links(6), joints=kinds, armature=np.array([0.2, 0.2, 1.0, 0.1, 0.05, 0.03])),
        viscous=np.array([0.3, 0.3, 5.0, 0.2, 0.1, 0.05]),
        coulomb=np.array([0.6, 0.5, 4.0, 0.4, 0.2, 0.1]),
        offset=np.array([0.1, -0.15, 0.5, 0.1, -0.05, 0.03]),
        limits=np.array([[-2.5, 2.5]] * 2 + [[-0.4, 0.4]] + [[-2.5, 2.5]] * 3),
        rates=np.array([2.0, 2.0, 0.8, 2.2, 2.6, 2.6]),
        accelerations=np.array([10.0, 8.0, 4.0, 12.0, 15.0, 20.0]),
    )


def links(d: int) -> list[np.ndarray]:
    """Physically consistent, asymmetric bodies, from 4 kg at the base to some 0.5 kg at the tip."""
    bodies = []
    for link in range(d):
        mass = 4.0 * 0.72**link
        centre = 0.12 * np.array([np.sin(1.0 + 2 * link), np.cos(2.0 + 3 * link), np.sin(3.0 + link)])
        size = 0.1 + 0.02 * np.array([np.cos(link), np.sin(2 * link), np.cos(3 * link)])
        turn, _ = np.linalg.qr(np.cos(np.arange(9.0) * (link + 1)).reshape(3, 3) + 2 * np.eye(3))
        moments = mass / 3 * (size @ size * np.eye(3) - np.diag(size**2))
        bodies.append(inertial_parameters(mass, centre, turn @ moments @ turn.T))
    return bodies


def sum_of_sines(arm: Arm, *, seed: int, duration: float = 50.0) -> tuple[np.ndarray, ...]:
    """t, q, qd, qdd at 100 Hz: qd = sum over k of a_k cos(k w t) + b_k sin(k w t), joint by joint, w = 2 pi / 50 s.

    a_k and b_k are uniform in ±0.1 r per second, with r a quarter of the range of a joint. A draw that leaves
    q_middle ± r, or is too fast, is repeated; after every ten tries the range shrinks by a factor 0.8.
    """
    t = 0.01 * np.arange(round(duration / 0.01) + 1)
    w = 2 * np.pi * 0.02 * np.arange(1, SINES + 1)
    cosines, sines = np.cos(np.outer(t, w)), np.sin(np.outer(t, w))
    random = np.random.default_rng(seed)
    joints, q, qd, qdd = [], t, t, t
    for limits, rate, acceleration in zip(arm.limits, arm.rates, arm.accelerations, strict=True):
        reach = 0.25 * np.ptp(limits)
        for tries in itertools.count():
            a, b = 0.1 * reach * 0.8 ** (tries // 10) * random.uniform(-1, 1, (2, SINES))
            q, qd = sines @ (a / w) - cosines @ (b / w), cosines @ a + sines @ b
            qdd = cosines @ (b * w) - sines @ (a * w)
            if abs(q).max() < reach and abs(qd).max() < rate and abs(qdd).max() < acceleration:
                break
        joints.append((q + limits.mean(), qd, qdd))
    return t, *np.array(joints).transpose(1, 2, 0)


def waves(a, w, angle, axis: int) -> list[np.ndarray]:
    """Sums over an axis of a sin(angle) and of its first two rates of change, for angles that grow at w."""
    return [np.sum(wave, axis) for wave in (a * np.sin(angle), a * w * np.cos(angle), -a * w**2 * np.sin(angle))]


@in_float64
def arm_torques(arm: Arm, q, qd, qdd, *, friction: bool) -> Float[np.ndarray, "N d"]:
    """Noiseless tau of states [N, d]; dry friction has the sign of the rate."""
    tau = np.asarray(jax.jit(jax.vmap(lambda *state: newton_euler(arm.tree, *state)))(q, qd, qdd))
    return tau + arm.viscous * qd + arm.coulomb * np.sign(qd) + arm.offset if friction else tau


def lip_trajectories(
    arm: Arm, seeds: Sequence[int] = (0,), *, friction: bool = False, noise: float = 0.01, every: int = 10
) -> Trajectories:
    """One trajectory per seed from `sum_of_sines`, of which every `every`-th sample (10 ms apart) is kept.

    `noise` is the standard deviation of the torques' noise, N m or N, drawn also for samples that are not kept.
    """
    parts = []
    for seed in seeds:
        motion = sum_of_sines(arm, seed=seed)
        errors = noise * np.random.default_rng([seed, 1]).normal(size=motion[1].shape)
        parts.append([values[::every] for values in (*motion, errors)])
    t, q, qd, qdd, errors = (np.concatenate(values) for values in zip(*parts, strict=True))
    tau = arm_torques(arm, q, qd, qdd, friction=friction) + errors
    trajectory = np.repeat(np.arange(len(seeds)), [len(part[0]) for part in parts])
    label = np.array([f"seed-{seed}" for seed in seeds])
    return Trajectories(t, q, qd, qdd, tau, trajectory, label, needs=arm.tree.needs._replace(friction=friction))
