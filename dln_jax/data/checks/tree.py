"""Checks a log against a robot's description: names, limits, signs, gravity, gears, excitation and order of joints."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.data.checks.channels import Finding, away_from_ends, findings_of
from dln_jax.data.checks.priors import Build, Hypothesis, Inertias, Prior, friction, gyroscopic, sizes_of
from dln_jax.data.checks.torques import Torques, check_torques, examine_torques
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.recursions import regressor
from dln_jax.precision import compiled
from dln_jax.solvers import least_squares
from dln_jax.types import JointKind

MOST = 800
PADDED = 200
"""Batches are padded to a multiple of this number of samples."""
TOLERANCE = 0.05
"""rad or m: tolerance beyond a limit."""
EXPLAINED = 0.02
"""If less than this fraction of the torques' variance is unexplained, their order counts as correct."""
BETTER = 0.3
"""Another order of the joints must lower the unexplained variance to this fraction."""
RELATED = 0.5
"""A measured torque belongs to a joint if its correlation with the tree's torque, without friction, is higher."""
GEAR = 5.0
"""A measured torque that exceeds the model's by more than this factor (or falls below its inverse) was probably
measured on the other side of the gear."""
TILTED = 4.0
"""Larger angles between the data's gravity and the description's, in degrees, are tested as a tilt."""
HELD = 0.3
"""Torques with a smaller fraction of the tree's gravity, but credible inertial forces, may have it removed."""
PACE = 0.03
"""A wrong clock is tested if the logarithm of the ratio of the robot's speed to the speed by t is larger."""
LENGTH = 0.1
"""m: uncertainty of a body's centre of mass relative to its file."""
ILL = 1000.0
"""Noise dominates the parameters if the condition of the scaled regressor is larger."""
RANK = 1e-7
"""Singular values below this fraction of the largest count as undetermined."""
LEFT = 1e-5
"""A joint is no evidence on units if friction and rotor explain all but this fraction of its torque."""
FRICTION_SCALE = 0.05
"""Smoothing velocity of dry friction, relative to the typical velocity of the joint."""


class OnTree(NamedTuple):
    """Result of comparing a log with a robot's description."""

    findings: list[Finding]
    rank: int
    """Number of combinations of tree and friction parameters that the motions determine."""
    parameters: int
    condition: float
    """Condition number of the scaled columns within the rank."""
    scale: np.ndarray
    """Ratio of the measured torque to the tree's, without friction [d]; NaN without torques."""
    gravity: np.ndarray
    """Gravity that explains the data best, in the ground frame, m/s² [3]; NaN if it cannot be estimated."""
    torques: Torques | None
    """Examination with a prior near the tree's parameters; `None` without torques or with too few samples."""


def compare_with_tree(
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
    findings = _names_and_limits(data, robot, names)
    inside = away_from_ends(data.trajectory, farthest)
    farthest, inside = (farthest, inside) if len(inside) else (0, np.arange(len(data.t)))
    chosen = inside[:: -(-len(inside) // MOST)]
    q, qd, qdd, tau = samples = tuple(getattr(data, key)[chosen] for key in ("q", "qd", "qdd", "tau"))
    n, d = q.shape
    tree, down = robot.tree, np.asarray(robot.tree.gravity, float)
    motors = np.asarray(tree.armature, float)
    phi = regressor_of(tree)
    theta = np.concatenate([np.ravel(tree.inertias), np.diag(motors) if motors.ndim == 2 else motors])
    varies = np.ptp(tau, axis=0) > 0
    sizes = np.where(varies, tau.std(axis=0), 1.0)
    # Viscous and dry friction and an offset of every joint [d, n, 3].
    slowest = FRICTION_SCALE * np.maximum(np.sqrt(np.mean(qd**2, axis=0)), 1e-12)
    losses = np.stack([qd, np.tanh(qd / slowest), np.ones_like(qd)], axis=2).swapaxes(0, 1)
    columns = np.concatenate(
        [phi(q, qd, qdd, down), np.einsum("jnk,ij->nijk", losses, np.eye(d)).reshape(n, d, -1)], axis=2
    )
    weighted = (columns / sizes[:, None]).reshape(n * d, -1)
    determined = least_squares.solve(weighted, (tau / sizes).ravel(), rank_tolerance=RANK, negligible=1e-9)
    facts = determined.rank, weighted.shape[1], determined.condition
    findings += findings_of(
        ("warning", "condition", determined.condition > ILL,
         f"the condition of the regressor is {determined.condition:.3g}",
         "excite the arm more: faster, over larger ranges, all joints at a time")
    )  # fmt: skip
    if not driven:
        return OnTree(findings, *facts, np.full(d, np.nan), np.full(3, np.nan), None)
    still = np.zeros_like(q)
    weight = [phi(q, still, still, axis) @ theta for axis in np.eye(3)]
    # Inertial and Coriolis forces, gravity of 1 m/s² along each axis, and measured torques, after projecting out
    # friction and rotors. Robot files rarely state the rotors' inertia, so it is no evidence of wrong units, clocks or
    # orders.
    forces = np.stack([phi(q, qd, qdd, np.zeros(3)) @ theta, *weight, tau], axis=2) / sizes[:, None]
    rubbing = np.concatenate([losses, qdd.T[..., None]], axis=2)
    basis, forces = np.linalg.qr(rubbing)[0], forces.swapaxes(0, 1)
    forces = forces - basis @ (basis.swapaxes(1, 2) @ forces)
    inertial, *estimate = np.full(4, np.nan)
    if varies.any() and down.any():
        rows = forces[varies].reshape(-1, 5)
        inertial, *estimate = least_squares.solve(rows[:, :4], rows[:, 4], rank_tolerance=1e-6, negligible=1e-9).x
    estimate = np.array(estimate)
    torques = examine_torques(
        data, near_tree(phi, theta, down, tree.joints), farthest=farthest, equations=equations,
        others=lambda log: _mounted_or_paced(log, inertial, estimate, down, of_clock=bool(varies.all())),
    )  # fmt: skip
    if torques is not None:
        findings += check_torques(torques, friction_stated=True, with_robot=True) + _base_and_clock(torques, down)
    modelled, measured = forces[..., 0] + forces[..., 1:4] @ down, forces[..., 4]
    product, own, other = (
        np.sum(x * y, axis=1) for x, y in ((modelled, measured), (modelled, modelled), (measured, measured))
    )
    known = np.minimum(own, other) > LEFT**2 * n
    scale = np.divide(product, own, out=np.full(d, np.nan), where=known)
    if not any(finding.check in ("order", "tree-sign", "gravity", "no-gravity", "clock") for finding in findings):
        # A column order that differs from the robot's changes the size of torques too, so it is tested before gears.
        correlation = np.divide(product, np.sqrt(own * other), out=np.zeros(d), where=known)
        geared = (np.abs(correlation) > RELATED) & ((np.abs(scale) > GEAR) | (np.abs(scale) < 1 / GEAR))
        findings += _better_order(phi, theta, down, samples, rubbing) or findings_of(
            ("error", "gear", geared,
             f"the torque of {{}} is {', '.join(f'{factor:.3g}' for factor in scale[geared])} times the tree's",
             "give torques on the link's side: times the gear ratio, or times the torque constant if it is a current")
        )  # fmt: skip
    return OnTree(findings, *facts, scale, estimate, torques)


def _names_and_limits(data: Trajectories, robot: Robot, names: tuple[str, ...]) -> list[Finding]:
    """Checks the names and order of joints, if both have names, and the position limits."""
    stated = robot.tree.names
    unlike, same = bool(names and stated and names != stated), set(names) == set(stated)
    both = f"the data's joints are {', '.join(names):.200}, the robot's {', '.join(stated):.200}"
    lower, upper = robot.position_limits.T
    beyond = np.mean((data.q < lower - TOLERANCE) | (data.q > upper + TOLERANCE), axis=0)
    return findings_of(
        ("error", "order", unlike and same, both, "order the columns as the robot does"),
        ("note", "order", unlike and not same, both, "check that the columns are in the robot's order"),
        ("warning", "limits", beyond > 1e-3,
         f"q of {{}} is outside the robot's limits in up to {beyond.max():.0%} of the samples",
         "check units, zeros and signs of q, and the order of the joints"),
    )  # fmt: skip


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
    return compiled(batch)


def near_tree(
    phi: Callable[..., np.ndarray], theta: np.ndarray, down: np.ndarray, joints: tuple[JointKind, ...]
) -> Build:
    """Returns the prior of a tree with bodies near the file's, any rotors, gyroscopic forces and friction."""
    d = len(theta) // 11
    bodies = np.abs(theta[: 10 * d]).reshape(d, 10)
    mass = np.maximum(bodies[:, :1], 1e-3 * bodies[:, :1].max())
    # If a mass in the file is wrong by 100 %, the centre of mass and inertia are off by these amounts.
    spread = np.hstack([mass, mass * LENGTH * np.ones((1, 3)), mass * LENGTH**2 * np.ones((1, 6))])
    sizes = np.maximum(bodies, spread).ravel()

    def build(log: Hypothesis) -> Prior:
        states, scales = log.states(), sizes_of(log)

        def weighted(columns: np.ndarray) -> list[np.ndarray]:
            return [columns[:, : 10 * d] * sizes, columns[:, 10 * d :] * scales]

        def inertias(pushed: Sequence[np.ndarray], rows: np.ndarray) -> Inertias:
            columns = rows @ phi(*pushed, np.zeros(3)).reshape(rows.shape[1], -1)
            parts = weighted(columns)
            shared = [part @ of_log.T for part, of_log in zip(parts, own, strict=True)]
            return columns @ theta, shared, [part @ part.T for part in parts], len(turning)

        columns = phi(*states, down if log.gravity is None else log.gravity).reshape(states[0].size, -1)
        own = weighted(columns)
        turning = gyroscopic(log, joints)
        return Prior(columns @ theta, turning, [*own, *friction(states[1])], inertias)

    return build


def _mounted_or_paced(
    log: Hypothesis, inertial: float, estimate: np.ndarray, down: np.ndarray, *, of_clock: bool
) -> list[Hypothesis]:
    """Returns logs without gravity, with a turned base, or at another speed, if the data suggest it."""
    if log.gravity is not None:
        return []
    logs = []
    length, stated = float(np.linalg.norm(estimate)), float(np.linalg.norm(down))
    if length < HELD * stated and 1 / GEAR < inertial < GEAR:
        logs.append(log._replace(gravity=np.zeros(3)))
    elif length > 0 and _angle(estimate, down) >= TILTED:
        logs.append(log._replace(gravity=estimate * stated / length))
    weight = estimate @ down / max(down @ down, 1e-300)
    if of_clock and log.speed == 1.0 and inertial > 0 and weight > HELD:
        speed = float(np.sqrt(inertial / weight))  # inertial forces scale with the square of the speed
        if abs(np.log(speed)) >= PACE:
            logs.append(log._replace(speed=speed))
    return logs


def _base_and_clock(torques: Torques, down: np.ndarray) -> list[Finding]:
    gravity, speed = torques.repaired.log.gravity, torques.repaired.log.speed
    if gravity is not None and not gravity.any():
        observation = f"tau does not include gravity ({torques.gain}): the robot's driver removes it"
        return [Finding("warning", "no-gravity", observation, "models are fitted without gravity; add it to commands")]
    if gravity is not None:
        estimate = "(" + ", ".join(f"{number:.1f}" for number in np.round(gravity, 1) + 0.0) + ")"
        observation = f"gravity is tilted by {_angle(gravity, down):.0f} degrees"
        remedy = "state how the base is mounted, or check where joints have zero"
        if gravity @ down < 0 and _angle(gravity, -down) < 2 * TILTED:
            observation = "gravity has the opposite direction"
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


def _better_order(
    phi: Callable[..., np.ndarray],
    theta: np.ndarray,
    gravity: np.ndarray,
    samples: tuple[np.ndarray, ...],
    friction: np.ndarray,
) -> list[Finding]:
    """Searches for a better joint order: two joints exchanged, all reversed, or all rotated.

    `samples` are q, qd, qdd and tau [n, d], `friction` the columns of friction and rotors [d, n, k].
    """
    q, qd, qdd, tau = samples
    d = q.shape[1]

    def unexplained(order: np.ndarray) -> float:
        there = phi(q[:, order], qd[:, order], qdd[:, order], gravity) @ theta
        shares = []
        for place, joint in enumerate(order):
            columns, torque = np.column_stack([there[:, place], friction[joint]]), tau[:, joint]
            factors = np.linalg.lstsq(columns, torque, rcond=1e-10)[0]
            left = torque - columns @ factors * (factors[0] > 0)  # torques of the other sign are impossible
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
