"""Checks of joint names, limits and column order against a robot, and the regressor used to judge them."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data.checks.findings import Finding, on_joints
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.trees import Tree, regressor
from dln_jax.types import JointKind

TOLERANCE = 0.05
"""rad or m: tolerance beyond a limit."""
EXPLAINED = 0.02
"""Unexplained fraction of the torques' variance below which their order counts as correct."""
PADDED = 200
"""Batches are padded to a multiple of this number of samples."""
BETTER = 0.3
"""Another order of the joints must lower the unexplained variance to this fraction."""


def parameters_of(tree: Tree) -> np.ndarray:
    """theta [11 d] of a tree with known inertias and armature, in the order of its regressor."""
    return np.concatenate([np.ravel(tree.inertias), np.ravel(tree.armature)])


def regressor_of(tree: Tree) -> Callable[..., np.ndarray]:
    """(q, qd, qdd [n, d], gravity [3]) -> Phi [n, d, 11 d] of a tree; trees of one structure share a program."""
    program = _program(tree.parents, tree.joints, tuple(map(tuple, np.asarray(tree.axes).tolist())))
    frames = np.asarray(tree.rotations, float), np.asarray(tree.positions, float)

    def phi(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        # Padding limits the number of shapes, and thus of compiled programs.
        missing = -len(q) % PADDED
        states = [np.pad(values, ((0, missing), (0, 0)), mode="edge") for values in (q, qd, qdd)]
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
    """Compares joint names and their order with the robot's; no finding if either has no names."""
    stated = robot.tree.names
    if not names or not stated or names == stated:
        return []
    observation = f"the data's joints are {', '.join(names):.200}, the robot's {', '.join(stated):.200}"
    if set(names) == set(stated):
        return [Finding("error", "order", observation, "order the columns as the robot does")]
    return [Finding("note", "order", observation, "check that the columns are in the robot's order")]


def limits(data: Trajectories, robot: Robot) -> list[Finding]:
    """Checks that positions are within the robot's limits."""
    lower, upper = robot.position_limits.T
    beyond = np.mean((data.q < lower - TOLERANCE) | (data.q > upper + TOLERANCE), axis=0)
    return on_joints(
        "warning", "limits", beyond > 1e-3,
        f"q of {{}} is outside the robot's limits in up to {beyond.max():.0%} of the samples",
        "check units, zeros and signs of q, and the order of the joints",
    )  # fmt: skip


def better_order(
    phi: Callable[..., np.ndarray],
    theta: np.ndarray,
    gravity: np.ndarray,
    samples: tuple[np.ndarray, ...],
    friction: np.ndarray,
) -> list[Finding]:
    """Searches for a joint order that explains the torques much better: two joints exchanged, all reversed or rotated.

    `samples` are q, qd, qdd and tau [n, d], `friction` the friction columns [d, n, 3].
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
    order = ", ".join(str(joint + 1) for joint in trials[best])
    observation = f"torques fit far better with the columns in the order {order}"
    return [Finding("error", "order", observation, "order the columns as the robot does")]
