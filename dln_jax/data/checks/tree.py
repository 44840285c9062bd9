"""Checks a log against a robot's description: signs, gravity, gears, excitation, and the order of the joints."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data.checks import energies
from dln_jax.data.checks.derivatives import away_from_ends
from dln_jax.data.checks.energies import Build, States
from dln_jax.data.checks.evidence import Prior
from dln_jax.data.checks.findings import Finding, on_joints
from dln_jax.data.checks.hypotheses import Log, Torques, examine_torques
from dln_jax.data.checks.joints import better_order, check_torques, limits, named_order
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.recursions import regressor
from dln_jax.solvers import least_squares
from dln_jax.types import JointKind

MOST = 800
PADDED = 200
"""Batches are padded to a multiple of this number of samples."""
RELATED = 0.5
"""A measured torque whose correlation with the tree's torque, without friction, is higher belongs to the same joint."""
GEAR = 5.0
"""A measured torque that exceeds the model's by more than this factor (or falls below its inverse) was probably
measured on the other side of the gear."""
TILTED = 4.0
"""Larger angles between the data's gravity and the description's, in degrees, are tested as a tilt."""
HELD = 0.3
"""Torques with a smaller fraction of the tree's gravity, and inertial forces of a credible size, may hold none."""
PACE = 0.03
"""A wrong clock is tested if the log ratio of the speeds that the robot and t imply is larger."""
LENGTH = 0.1
"""m: uncertainty of a body's centre of mass relative to its file."""
ILL = 1000.0
"""Noise dominates the parameters if the condition of the scaled regressor is larger."""
RANK = 1e-7
"""Singular values below this fraction of the largest count as undetermined."""
LEFT = 1e-5
"""A joint whose friction and rotor leave less than this fraction of its torque says nothing of units."""
FRICTION_SCALE = 0.05
"""Smoothing velocity of dry friction, relative to the typical velocity of the joint."""


class OnTree(NamedTuple):
    """Result of comparing a log with a robot's description."""

    findings: list[Finding]
    scale: np.ndarray
    """Measured torque over the tree's, without friction [d]; NaN without torques."""
    correlation: np.ndarray
    """Correlation of both, without friction [d]."""
    gravity: np.ndarray
    """Gravity that explains the data best, in the ground frame, m/s² [3]; NaN if it cannot be estimated."""
    rank: int
    """Number of combinations of tree and friction parameters that the motions determine."""
    parameters: int
    condition: float
    """Condition of the scaled columns within the rank."""
    torques: Torques | None
    """Examination with a prior near the tree's parameters; `None` without torques or with too few samples."""


def against_tree(
    data: Trajectories, robot: Robot, names: tuple[str, ...], *, driven: bool, farthest: int, equations: int
) -> OnTree:
    """Compares samples with sound rates with a robot's tree.

    Args:
        data: samples in the robot's joint order.
        names: joint names of the data, if stated.
        driven: whether there are torques.
        farthest: largest delay tried, in samples.
        equations: number of torques, over all joints, used to search for faults.
    """
    findings = named_order(robot, names) + limits(data, robot)
    inside = away_from_ends(data.trajectory, farthest)
    farthest, inside = (farthest, inside) if len(inside) else (0, np.arange(len(data.t)))
    chosen = inside[:: -(-len(inside) // MOST)]
    q, qd, qdd, tau = samples = tuple(getattr(data, key)[chosen] for key in ("q", "qd", "qdd", "tau"))
    tree, down = robot.tree, np.asarray(robot.tree.gravity, float)
    motors = np.asarray(tree.armature, float)
    phi = regressor_of(tree)
    theta = np.concatenate([np.ravel(tree.inertias), np.diag(motors) if motors.ndim == 2 else motors])
    friction = _friction(qd)
    varies = np.ptp(tau, axis=0) > 0
    sizes = np.where(varies, tau.std(axis=0), 1.0)
    rank, parameters, condition = _determined(phi(q, qd, qdd, down), friction, sizes, tau)
    if condition > ILL:
        observation = f"the condition of the regressor is {condition:.3g}"
        remedy = "excite the arm more: faster, over larger ranges, all joints at a time"
        findings.append(Finding("warning", "condition", observation, remedy))
    if not driven:
        unknown = np.full(q.shape[1], np.nan)
        return OnTree(findings, unknown, unknown, np.full(3, np.nan), rank, parameters, condition, None)
    still = np.zeros_like(q)
    weight = [phi(q, still, still, axis) @ theta for axis in np.eye(3)]
    forces = np.stack([phi(q, qd, qdd, np.zeros(3)) @ theta, *weight, tau], axis=2) / sizes[:, None]
    # Files of robots rarely hold the rotors' inertia, so it is no evidence for wrong units, clocks or orders.
    rubbing = np.concatenate([friction, qdd.T[..., None]], axis=2)
    rows = _without(forces, rubbing)
    scale, correlation = _by_joint(rows, down)
    inertial, *estimate = _gravity(rows[varies], down)
    estimate = np.array(estimate)
    torques = examine_torques(
        data, near_tree(phi, theta, down, tree.joints), farthest=farthest, equations=equations,
        others=lambda log: [
            *_mounted(log, inertial, estimate, down), *(_paced(log, inertial, estimate, down) if varies.all() else [])
        ],
    )  # fmt: skip
    if torques is not None:
        findings += check_torques(data, torques, friction_stated=True, with_robot=True) + _base_and_clock(torques, down)
    if not any(finding.check in ("order", "tree-sign", "gravity", "no-gravity", "clock") for finding in findings):
        # A column order that differs from the robot's changes the size of torques too, so it is tested before gears.
        findings += better_order(phi, theta, down, samples, rubbing) or _gears(scale, correlation)
    return OnTree(findings, scale, correlation, estimate, rank, parameters, condition, torques)


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


def near_tree(
    phi: Callable[..., np.ndarray], theta: np.ndarray, down: np.ndarray, joints: tuple[JointKind, ...]
) -> Build:
    """Prior of the torques of a tree with bodies near those of its file, any rotors, gyroscopic forces and friction."""
    d = len(theta) // 11
    bodies = np.abs(theta[: 10 * d]).reshape(d, 10)
    mass = np.maximum(bodies[:, :1], 1e-3 * bodies[:, :1].max())
    # If the file is wrong by a body's own mass, its centre of mass and inertia are off by these amounts.
    spread = np.hstack([mass, mass * LENGTH * np.ones((1, 3)), mass * LENGTH**2 * np.ones((1, 6))])
    sizes = np.maximum(bodies, spread).ravel()

    def build(states: States, tau: np.ndarray, gravity: np.ndarray | None) -> Prior:
        scales = energies.sizes_of(states[2], tau)

        def weighted(columns: np.ndarray) -> list[np.ndarray]:
            return [columns[:, : 10 * d] * sizes, columns[:, 10 * d :] * scales]

        def inertias(pushed: States, rows: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray], int]:
            columns = rows @ phi(*pushed, np.zeros(3)).reshape(rows.shape[1], -1)
            parts = weighted(columns)
            shared = [part @ of_log.T for part, of_log in zip(parts, own, strict=True)]
            return columns @ theta, shared, [part @ part.T for part in parts], len(turning)

        columns = phi(*states, down if gravity is None else gravity).reshape(tau.size, -1)
        own = weighted(columns)
        turning = energies.gyroscopic(states, joints, scales)
        return Prior(columns @ theta, turning, [*own, *energies.friction(states[1])], inertias)

    return build


def _mounted(log: Log, inertial: float, estimate: np.ndarray, down: np.ndarray) -> list[Log]:
    """The log without gravity, or of a robot with its base turned, as the data suggest."""
    length, stated = float(np.linalg.norm(estimate)), float(np.linalg.norm(down))
    if log.gravity is not None:
        return []
    if length < HELD * stated and 1 / GEAR < inertial < GEAR:
        return [log._replace(gravity=np.zeros(3))]
    tilted = length > 0 and _angle(estimate, down) >= TILTED
    return [log._replace(gravity=estimate * stated / length)] if tilted else []


def _paced(log: Log, inertial: float, estimate: np.ndarray, down: np.ndarray) -> list[Log]:
    """The log at the speed that the inertial forces imply; they scale with the square of the speed."""
    weight = estimate @ down / max(down @ down, 1e-300)
    if log.speed != 1.0 or log.gravity is not None or not (inertial > 0 and weight > HELD):
        return []
    speed = float(np.sqrt(inertial / weight))
    return [] if abs(np.log(speed)) < PACE else [log._replace(speed=speed)]


def _base_and_clock(torques: Torques, down: np.ndarray) -> list[Finding]:
    gravity, speed = torques.log.gravity, torques.log.speed
    if gravity is not None and not gravity.any():
        observation = f"tau holds no gravity ({torques.gain}): the robot's driver removes it"
        return [Finding("warning", "no-gravity", observation, "models are fitted without gravity; add it to commands")]
    if gravity is not None:
        estimate = "(" + ", ".join(f"{number:.1f}" for number in np.round(gravity, 1) + 0.0) + ")"
        observation = f"gravity is tilted by {_angle(gravity, down):.0f} degrees"
        remedy = "state how the base is mounted, or check where joints have zero"
        if gravity @ down < 0 and _angle(gravity, -down) < 2 * TILTED:
            observation = "gravity points the other way"
            remedy = "reverse gravity in the description, or check how the arm is mounted and where joints have zero"
        observation += f": the data imply {estimate} m/s² ({torques.gain})"
        return [Finding("error", "gravity", observation, remedy)]
    if speed != 1.0:
        observation = (
            f"the robot's inertia implies motions about {speed:.2g} times as fast as t states ({torques.gain})"
        )
        remedy = "check that t is in seconds, and the sampling rate of the log"
        return [Finding("error", "clock", observation, remedy)]
    return []


def _angle(first: np.ndarray, second: np.ndarray) -> float:
    """Angle between two vectors, degrees."""
    cosine = first @ second / max(float(np.linalg.norm(first) * np.linalg.norm(second)), 1e-300)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _friction(qd: np.ndarray) -> np.ndarray:
    """Viscous and dry friction and an offset of every joint [d, n, 3]."""
    scales = FRICTION_SCALE * np.maximum(np.sqrt(np.mean(qd**2, axis=0)), 1e-12)
    return np.stack([qd, np.tanh(qd / scales), np.ones_like(qd)], axis=2).swapaxes(0, 1)


def _determined(
    columns: np.ndarray, friction: np.ndarray, sizes: np.ndarray, tau: np.ndarray
) -> tuple[int, int, float]:
    """Rank, number and condition of the columns of the tree [n, d, P] and of the friction of every joint."""
    n, d, _ = columns.shape
    own = np.einsum("jnk,ij->nijk", friction, np.eye(d)).reshape(n, d, -1)
    weighted = (np.concatenate([columns, own], axis=2) / sizes[:, None]).reshape(n * d, -1)
    solution = least_squares.solve(weighted, (tau / sizes).ravel(), rank_tolerance=RANK, negligible=1e-9)
    return solution.rank, weighted.shape[1], solution.condition


def _without(forces: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Part of the forces [n, d, 5] that these columns [d, n, k] do not explain, joint by joint [d, n, 5].

    The forces are inertial with Coriolis, gravity of 1 m/s² along each axis, and measured, all divided by the standard
    deviation of the joint's torque.
    """
    basis = np.linalg.qr(columns)[0]
    forces = forces.swapaxes(0, 1)
    return forces - basis @ (basis.swapaxes(1, 2) @ forces)


def _gears(scale: np.ndarray, correlation: np.ndarray) -> list[Finding]:
    sizes = np.abs(scale)
    geared = (np.abs(correlation) > RELATED) & ((sizes > GEAR) | (sizes < 1 / GEAR))
    return on_joints(
        "error", "gear", geared,
        f"the torque of {{}} is {', '.join(f'{factor:.3g}' for factor in scale[geared])} times the tree's",
        "give torques on the link's side: times the gear ratio, or times the torque constant if it is a current",
    )  # fmt: skip


def _by_joint(rows: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scale and correlation of measured torques relative to the tree's, without friction and rotors."""
    tree, measured = rows[..., 0] + rows[..., 1:4] @ down, rows[..., 4]
    product, *sizes = (np.sum(x * y, axis=1) for x, y in ((tree, measured), (tree, tree), (measured, measured)))
    known = np.minimum(*sizes) > LEFT**2 * rows.shape[1]
    scale = np.divide(product, sizes[0], out=np.full(len(rows), np.nan), where=known)
    correlation = np.divide(product, np.sqrt(sizes[0] * sizes[1]), out=np.zeros(len(rows)), where=known)
    return scale, correlation


def _gravity(rows: np.ndarray, down: np.ndarray) -> np.ndarray:
    """The scale of inertial forces and the gravity [3] that explain the torques of all joints best."""
    if not len(rows) or not np.any(down):
        return np.full(4, np.nan)
    rows = rows.reshape(-1, 5)
    return least_squares.solve(rows[:, :4], rows[:, 4], rank_tolerance=1e-6, negligible=1e-9).x
