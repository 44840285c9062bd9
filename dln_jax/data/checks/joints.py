"""Which column is which joint: names, limits, and the order in which torques fit; and the regressor to judge by."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data.checks.findings import Finding, named
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.trees import Tree, regressor
from dln_jax.types import JointKind

OUTSIDE = 0.05
"""rad or m beyond a limit."""
EXPLAINED = 0.02
"""Of the torques' variance left unexplained, below which their order is right."""
PADDED = 200
"""Samples to a multiple of which a batch is filled up."""
BETTER = 0.3
"""Of the unexplained variance that another order of the joints leaves."""


def parameters_of(tree: Tree) -> np.ndarray:
    """theta [11 d] of a tree of known numbers, as its regressor takes them."""
    return np.concatenate([np.ravel(tree.inertias), np.ravel(tree.armature)])


def regressor_of(tree: Tree) -> Callable[..., np.ndarray]:
    """(q, qd, qdd [n, d], gravity [3]) -> Phi [n, d, 11 d] of a tree: one program for trees of one structure."""
    program = _program(tree.parents, tree.joints, tuple(map(tuple, np.asarray(tree.axes).tolist())))
    frames = np.asarray(tree.rotations, float), np.asarray(tree.positions, float)

    def phi(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        # Few shapes make few programs.
        missing = -len(q) % PADDED
        states = [np.concatenate([each, np.repeat(each[-1:], missing, axis=0)]) for each in (q, qd, qdd)]
        with jax.enable_x64(True):
            return np.asarray(program(*frames, np.asarray(gravity, float), *states))[: len(q)]

    return phi


@functools.cache
def _program(parents: tuple[int, ...], joints: tuple[JointKind, ...], axes: tuple[tuple[float, ...], ...]) -> Any:
    d = len(parents)

    def one(rotations, positions, gravity, q, qd, qdd):
        inertias, armature = np.zeros((d, 10)), np.zeros(d)
        tree = Tree(parents, joints, rotations, positions, np.array(axes), inertias, armature, gravity)
        return regressor(tree, q, qd, qdd)

    batch = jax.vmap(one, in_axes=(None, None, None, 0, 0, 0))
    return jax.jit(batch, compiler_options=quick_compilation())


def named_order(robot: Robot, names: tuple[str, ...]) -> list[Finding]:
    """Whether the data name their joints as the robot does, and in its order; nothing where either names none."""
    stated = robot.tree.names
    if not names or not stated or names == stated:
        return []
    if set(names) == set(stated):
        said = f"the data's joints are {', '.join(names)}, the robot's {', '.join(stated)}"
        return [Finding("error", "order", said, "order the columns as the robot does")]
    said = f"the data name joints {', '.join(names)[:80]}, the robot {', '.join(stated)[:80]}"
    return [Finding("note", "order", said, "see that the columns are in the robot's order")]


def limits(data: Trajectories, robot: Robot) -> list[Finding]:
    """Whether positions are within the robot's limits."""
    low, high = robot.position_limits.T
    outside = np.mean((data.q < low - OUTSIDE) | (data.q > high + OUTSIDE), axis=0)
    joints = np.flatnonzero(outside > 1e-3)
    if not len(joints):
        return []
    said = f"q of {named(joints)} is outside the robot's limits in up to {outside.max():.0%} of the samples"
    remedy = "see units, zeros and signs of q, and the order of the joints"
    return [Finding("warning", "limits", said, remedy, tuple(map(int, joints)))]


def better_order(
    phi: Callable[..., np.ndarray],
    theta: np.ndarray,
    gravity: np.ndarray,
    samples: tuple[np.ndarray, ...],
    friction: list[np.ndarray],
) -> list[Finding]:
    """Whether another order of the joints explains their torques far better: two exchanged, all reversed or shifted.

    `samples` are q, qd, qdd and tau [n, d], `friction` each joint's columns of friction [n, 3].
    """
    q, qd, qdd, tau = samples
    d = q.shape[1]

    def unexplained(order: np.ndarray) -> float:
        there = phi(q[:, order], qd[:, order], qdd[:, order], gravity) @ theta
        shares = []
        for place, joint in enumerate(order):
            columns, torque = np.column_stack([there[:, place], friction[joint]]), tau[:, joint]
            left = torque - columns @ np.linalg.lstsq(columns, torque, rcond=1e-10)[0]
            shares.append(left.var() / max(torque.var(), np.finfo(float).tiny))
        return float(np.mean(shares))

    now = unexplained(np.arange(d))
    if d < 2 or now < EXPLAINED:
        return []
    trials = [np.arange(d)[::-1], *(np.roll(np.arange(d), shift) for shift in range(1, d))]
    for first in range(d):
        for second in range(first + 1, d):
            trials.append(np.arange(d))
            trials[-1][[first, second]] = second, first
    shares = [unexplained(order) for order in trials]
    best = int(np.argmin(shares))
    if shares[best] > BETTER * now:
        return []
    said = f"torques fit far better with the columns in the order {', '.join(str(j + 1) for j in trials[best])}"
    return [Finding("error", "order", said, "order the columns as the robot does")]
