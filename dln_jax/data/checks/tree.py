"""Checks a log against a robot's description: signs, gravity, gears, excitation, and the order of the joints."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from dln_jax.data.checks.delays import away_from_ends
from dln_jax.data.checks.evidence import Prior
from dln_jax.data.checks.findings import Finding, named
from dln_jax.data.checks.hypotheses import Torques, examine_torques
from dln_jax.data.checks.joints import better_order, limits, named_order, parameters_of, regressor_of
from dln_jax.data.checks.repaired import Build, Log, States
from dln_jax.data.checks.repaired import friction as friction_of
from dln_jax.data.checks.torques import check_torques
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.solvers import least_squares

MOST = 800
"""Number of samples used."""
RELATED = 0.5
"""Correlation with the tree's torque, without friction, above which a measured torque belongs to the same joint."""
GEAR = 5.0
"""A measured torque that exceeds the model's by more than this factor (or falls below its inverse) was probably
measured on the other side of the gear."""
TILTED = 4.0
"""Degrees between the data's gravity and the description's, above which a tilt is tested."""
PACE = 0.03
"""Log ratio of the speeds by the robot and by t, above which a wrong clock is tested."""
LENGTH = 0.1
"""m: uncertainty of a body's centre of mass relative to its file."""
EQUATIONS = 1000
"""Number of torques, over all joints, used to search for faults."""
ILL = 1000.0
"""Condition of the scaled regressor above which noise dominates the parameters."""
RANK = 1e-7
"""Singular values below this fraction of the largest count as undetermined."""
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


class _Forces(NamedTuple):
    """Forces of the tree along the motions, and measured torques."""

    inertial: np.ndarray
    """Inertial and Coriolis forces [n, d]."""
    gravity: np.ndarray
    """Forces of 1 m/s² gravity along each axis [n, d, 3]."""
    measured: np.ndarray
    """[n, d]."""
    friction: list[np.ndarray]
    """Friction columns [n, 3] of every joint."""


def against_tree(
    data: Trajectories,
    robot: Robot,
    names: tuple[str, ...],
    *,
    driven: bool,
    farthest: int = 0,
    equations: int = EQUATIONS,
) -> OnTree:
    """Compares samples with sound rates with a robot's tree.

    Args:
        data: samples in the robot's joint order.
        robot: the robot's description.
        names: joint names of the data, if stated.
        driven: whether there are torques.
        farthest: largest delay tried, in samples.
        equations: number of torques, over all joints, used to search for faults.
    """
    found = named_order(robot, names) + limits(data, robot)
    inside = away_from_ends(data.trajectory, farthest)
    farthest, inside = (farthest, inside) if len(inside) else (0, np.arange(len(data.t)))
    chosen = inside[:: -(-len(inside) // MOST)]
    q, qd, qdd, tau = (getattr(data, key)[chosen] for key in ("q", "qd", "qdd", "tau"))
    phi, theta, down = regressor_of(robot.tree), parameters_of(robot.tree), np.asarray(robot.tree.gravity, float)
    friction = _friction_columns(qd)
    columns = _with_friction(phi(q, qd, qdd, down), friction)
    rank, condition = _determined(columns, tau, driven=driven)
    if condition > ILL:
        said = f"the condition of the regressor is {condition:.3g}"
        found.append(
            Finding("warning", "condition", said, "excite the arm more: faster, farther, all joints at a time")
        )
    if not driven:
        unknown = np.full(q.shape[1], np.nan)
        return OnTree(found, unknown, unknown, np.full(3, np.nan), rank, columns.shape[1], condition, None)
    still = np.zeros_like(q)
    along = np.stack([phi(q, still, still, axis) @ theta for axis in np.eye(3)], axis=2)
    forces = _Forces(phi(q, qd, qdd, np.zeros(3)) @ theta, along, tau, friction)
    scale, correlation = _by_joint(forces, down)
    estimate = _gravity(forces, down)
    torques = examine_torques(
        data, near_tree(phi, theta, down), farthest=farthest, equations=equations,
        ambiguous=False, others=lambda log: _mounted(log, estimate, down) + _paced(log, forces, down),
    )  # fmt: skip
    geared = _gears(scale, correlation)
    if torques is not None:
        found += check_torques(data, torques, friction_stated=True, by="robot") + _base_and_clock(torques, down)
    if not any(each.check in ("order", "tree-sign", "gravity", "clock") for each in found):
        # A column order that differs from the robot's changes the size of torques too, so it is tested before gears.
        found += better_order(phi, theta, down, (q, qd, qdd, tau), friction) or geared
    return OnTree(found, scale, correlation, estimate, rank, columns.shape[1], condition, torques)


def near_tree(phi: Callable[..., np.ndarray], theta: np.ndarray, down: np.ndarray) -> Build:
    """Prior of the torques of a tree with parameters near those of its file, and friction."""
    d = len(theta) // 11
    bodies = np.abs(theta[: 10 * d]).reshape(d, 10)
    mass = np.maximum(bodies[:, :1], 1e-3 * bodies[:, :1].max())
    # If the file is wrong by a body's own mass, its centre of mass and inertia are off by these amounts.
    spread = np.hstack([mass, mass * LENGTH * np.ones((1, 3)), mass * LENGTH**2 * np.ones((1, 6))])
    sizes = np.concatenate([np.maximum(bodies, spread).ravel(), np.full(d, float(spread[:, 4].max()))])

    def build(states: States, tau: np.ndarray, gravity: np.ndarray | None) -> Prior:
        columns = phi(*states, down if gravity is None else gravity).reshape(tau.size, -1)
        return Prior(columns @ theta, [], [columns * sizes, *friction_of(states[1])])

    return build


def _mounted(log: Log, estimate: np.ndarray, down: np.ndarray) -> list[Log]:
    """The log of a robot with its base turned as the data suggest."""
    length = float(np.linalg.norm(estimate))
    if log.gravity is not None or not length > 0 or _angle(estimate, down) < TILTED:
        return []
    return [log._replace(gravity=estimate * np.linalg.norm(down) / length)]


def _paced(log: Log, forces: _Forces, down: np.ndarray) -> list[Log]:
    """The log at the speed that the inertial forces imply; they scale with the square of the speed."""
    if log.speed != 1.0:
        return []
    rows, rhs = [], []
    for joint, columns in enumerate(forces.friction):
        block = np.column_stack([forces.inertial[:, joint], forces.gravity[:, joint] @ down, forces.measured[:, joint]])
        basis = np.linalg.qr(columns)[0]
        block = (block - basis @ (basis.T @ block)) / max(float(forces.measured[:, joint].std()), 1e-300)
        rows.append(block[:, :2])
        rhs.append(block[:, 2])
    inertial, weight = np.linalg.lstsq(np.concatenate(rows), np.concatenate(rhs), rcond=1e-10)[0]
    if not (inertial > 0 and weight > 0):
        return []
    speed = float(np.sqrt(inertial / weight))
    return [] if abs(np.log(speed)) < PACE else [log._replace(speed=speed)]


def _base_and_clock(found: Torques, down: np.ndarray) -> list[Finding]:
    gravity, speed = found.log.gravity, found.log.speed
    before, after = (each.unexplained.mean() for each in (found.explanation, found.repaired))
    gain = f"unexplained in blocks left out: {before:.2%} now, {after:.2%} then"
    if gravity is not None and gravity @ down < 0 and _angle(gravity, -down) < 2 * TILTED:
        said = f"gravity pulls the other way: the data say {_rounded(gravity)} m/s² ({gain})"
        remedy = "turn gravity round in the description, or see how the arm is mounted and where its joints have zero"
        return [Finding("error", "gravity", said, remedy)]
    if gravity is not None:
        said = (
            f"gravity is tilted by {_angle(gravity, down):.0f} degrees: the data say {_rounded(gravity)} m/s² ({gain})"
        )
        return [Finding("error", "gravity", said, "state how the base is mounted, or see where joints have zero")]
    if speed != 1.0:
        said = f"the robot's inertia asks for motions about {speed:.2g} times as fast as t says ({gain})"
        return [Finding("error", "clock", said, "see whether t is in seconds, and the rate at which the log was taken")]
    return []


def _angle(first: np.ndarray, second: np.ndarray) -> float:
    """Angle between two vectors, degrees."""
    cosine = first @ second / max(float(np.linalg.norm(first) * np.linalg.norm(second)), 1e-300)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _scales(qd: np.ndarray) -> np.ndarray:
    return FRICTION_SCALE * np.maximum(np.sqrt(np.mean(qd**2, axis=0)), 1e-12)


def _friction_columns(qd: np.ndarray) -> list[np.ndarray]:
    dry = np.tanh(qd / _scales(qd))
    return [np.column_stack([qd[:, joint], dry[:, joint], np.ones(len(qd))]) for joint in range(qd.shape[1])]


def _determined(columns: np.ndarray, tau: np.ndarray, *, driven: bool) -> tuple[int, float]:
    """Rank and condition of the columns."""
    n, d = tau.shape
    sizes = np.where(tau.std(axis=0) > 0, tau.std(axis=0), 1.0) if driven else np.ones(d)
    weighted = (columns.reshape(n, d, -1) / sizes[:, None]).reshape(n * d, -1)
    solution = least_squares.solve(weighted, (tau / sizes).ravel(), rank_tolerance=RANK, negligible=1e-9)
    return solution.rank, solution.condition


def _with_friction(columns: np.ndarray, friction: list[np.ndarray]) -> np.ndarray:
    """The regressor [n d, P] extended by viscous friction, dry friction and offset of every joint."""
    d = len(friction)
    own = np.zeros((len(columns), d, 3 * d))
    for joint, block in enumerate(friction):
        own[:, joint, 3 * joint : 3 * joint + 3] = block
    return np.concatenate([columns, own], axis=2).reshape(len(columns) * d, -1)


def _rounded(vector: np.ndarray) -> str:
    return "(" + ", ".join(f"{each:.1f}" for each in vector + 0.0) + ")"


def _gears(scale: np.ndarray, correlation: np.ndarray) -> list[Finding]:
    sizes = np.abs(scale)
    geared = np.flatnonzero((np.abs(correlation) > RELATED) & ((sizes > GEAR) | (sizes < 1 / GEAR)))
    if not len(geared):
        return []
    said = f"the torque of {named(geared)} is {', '.join(f'{scale[joint]:.3g}' for joint in geared)} times the tree's"
    remedy = "give torques on the link's side: times the gear ratio, or times the torque constant if it is a current"
    return [Finding("error", "gear", said, remedy, tuple(map(int, geared)))]


def _by_joint(forces: _Forces, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scale and correlation of measured torques relative to the tree's, without friction."""
    scale, correlation = [], []
    for joint, columns in enumerate(forces.friction):
        basis = np.linalg.qr(columns)[0]
        of_joint = (forces.inertial[:, joint] + forces.gravity[:, joint] @ down, forces.measured[:, joint])
        tree, measured = (x - basis @ (basis.T @ x) for x in of_joint)
        sizes = float(tree @ tree), float(measured @ measured)
        known = min(sizes) > 0
        scale.append(float(tree @ measured) / sizes[0] if known else np.nan)
        correlation.append(float(tree @ measured) / np.sqrt(sizes[0] * sizes[1]) if known else 0.0)
    return np.array(scale), np.array(correlation)


def _gravity(forces: _Forces, down: np.ndarray) -> np.ndarray:
    """The gravity that explains the torques of all joints best, with inertial forces scaled freely."""
    rows, rhs = [], []
    for joint, columns in enumerate(forces.friction):
        measured = forces.measured[:, joint]
        if measured.std() == 0:
            continue
        basis = np.linalg.qr(columns)[0]
        block = np.column_stack([forces.inertial[:, joint], forces.gravity[:, joint], measured]) / measured.std()
        block = block - basis @ (basis.T @ block)
        rows.append(block[:, :4])
        rhs.append(block[:, 4])
    if not rows or not np.any(down):
        return np.full(3, np.nan)
    free = least_squares.solve(np.concatenate(rows), np.concatenate(rhs), rank_tolerance=1e-6, negligible=1e-9)
    return free.x[1:]
