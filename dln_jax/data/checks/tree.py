"""Checks of a log against a robot's description: signs, gravity, gears, excitation, and which joint is which."""

from typing import NamedTuple

import numpy as np

from dln_jax.data.checks.delays import Delays, away_from_ends, delay_of
from dln_jax.data.checks.findings import Finding, named
from dln_jax.data.checks.joints import better_order, limits, named_order, parameters_of, regressor_of
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.solvers import least_squares

MOST = 800
"""Samples that are looked at."""
RELATED = 0.5
"""Correlation of a torque and the tree's, friction apart, from which they are of one joint."""
GEAR = 5.0
"""A torque so many times the tree's, or less than it by so much, is that of another side of a gear."""
SEEN = 0.02
"""By so much the squared error grows without a term that counts."""
TILTED = 20.0
"""Degrees between the gravity of the data and that of the description."""
TILT_EXPLAINS = 0.8
"""Of the squared error, which a free gravity has to come below before it is believed."""
ILL = 1000.0
"""Condition of the scaled regressor, above which noise decides parameters."""
RANK = 1e-7
"""Singular values below it, relative to the largest, are not determined."""
FRICTION_SCALE = 0.05
"""Of a joint's typical velocity, on which dry friction is smooth."""


class FrictionSeen(NamedTuple):
    """Torques without what any parameters of a tree explain of them but friction."""

    rows: np.ndarray
    """Samples [n]."""
    rest: np.ndarray
    """Friction and error [n, d], N m or N."""
    viscous: np.ndarray
    """[d], N m s or N s/m."""
    coulomb: np.ndarray
    """[d], N m or N."""
    velocity_scale: np.ndarray
    """[d], 1/s or m/s, on which dry friction is smooth."""
    explained: np.ndarray
    """Share of each torque's variance, friction included [d]."""


class OnTree(NamedTuple):
    """What a robot's description says of a log."""

    findings: list[Finding]
    scale: np.ndarray
    """Measured torque over the tree's, friction apart [d]; NaN without torques."""
    correlation: np.ndarray
    """Of both, friction apart [d]."""
    gravity: np.ndarray
    """That explains the data best, in the frame of the ground, in m/s² [3]; NaN where the data do not tell."""
    rank: int
    """Combinations of the tree's and the friction's parameters that the motions determine."""
    parameters: int
    condition: float
    """Of the scaled columns that count."""
    delays: Delays | None
    """Of torques against positions, by any parameters of the tree; `None` without torques."""
    friction: FrictionSeen | None
    """Beside the parameters of the tree that fit best; `None` without torques."""


class _Forces(NamedTuple):
    """Of the tree along the motions, and the measured ones."""

    inertial: np.ndarray
    """With the Coriolis forces [n, d]."""
    gravity: np.ndarray
    """Of 1 m/s² along each axis [n, d, 3]."""
    measured: np.ndarray
    """[n, d]."""
    friction: list[np.ndarray]
    """Columns of each joint's friction [n, 3]."""


def against_tree(
    data: Trajectories, robot: Robot, names: tuple[str, ...], *, driven: bool, farthest: int = 0
) -> OnTree:
    """Compares samples whose rates are sound with the tree.

    Args:
        data: in the robot's order of joints.
        robot: as described.
        names: the data's joints, where they state them.
        driven: whether there are torques.
        farthest: samples of delay that are tried.
    """
    found = named_order(robot, names) + limits(data, robot)
    inside = away_from_ends(data.trajectory, farthest)
    farthest, inside = (farthest, inside) if len(inside) else (0, np.arange(len(data.t)))
    chosen = inside[:: -(-len(inside) // MOST)]
    q, qd, qdd, tau = (getattr(data, key)[chosen] for key in ("q", "qd", "qdd", "tau"))
    phi, theta, down = regressor_of(robot.tree), parameters_of(robot.tree), np.asarray(robot.tree.gravity, float)
    friction = _friction_columns(qd)
    columns = _with_friction(phi(q, qd, qdd, down), friction)
    rank, parameters, condition, seen = _fitted(columns, tau, qd, chosen, driven=driven)
    if condition > ILL:
        said = f"the condition of the regressor is {condition:.3g}"
        found.append(
            Finding("warning", "condition", said, "excite the arm more: faster, farther, all joints at a time")
        )
    if not driven:
        unknown = np.full(q.shape[1], np.nan)
        return OnTree(found, unknown, unknown, np.full(3, np.nan), rank, parameters, condition, None, None)
    still = np.zeros_like(q)
    along = np.stack([phi(q, still, still, axis) @ theta for axis in np.eye(3)], axis=2)
    forces = _Forces(phi(q, qd, qdd, np.zeros(3)) @ theta, along, tau, friction)
    scale, correlation, signs = _by_joint(forces, down)
    estimate, tilt = _gravity(forces, down)
    wrong_order = better_order(phi, theta, down, (q, qd, qdd, tau), friction)
    if wrong_order and not any(each.check == "order" for each in found):
        found += wrong_order
    else:
        found += _signs(correlation, signs, estimate, tilt, down) + _gears(scale, correlation)
    shifted = np.stack([data.tau[chosen + shift] for shift in range(-farthest, farthest + 1)], axis=2)
    delays = delay_of(columns, shifted, float(np.median(np.diff(data.t)[np.diff(data.trajectory) == 0])))
    found += delays.findings
    return OnTree(found, scale, correlation, estimate, rank, parameters, condition, delays, seen)


def _scales(qd: np.ndarray) -> np.ndarray:
    return FRICTION_SCALE * np.maximum(np.sqrt(np.mean(qd**2, axis=0)), 1e-12)


def _friction_columns(qd: np.ndarray) -> list[np.ndarray]:
    dry = np.tanh(qd / _scales(qd))
    return [np.column_stack([qd[:, joint], dry[:, joint], np.ones(len(qd))]) for joint in range(qd.shape[1])]


def _fitted(
    columns: np.ndarray, tau: np.ndarray, qd: np.ndarray, chosen: np.ndarray, *, driven: bool
) -> tuple[int, int, float, FrictionSeen | None]:
    """Rank, parameters and condition of the columns, and the friction that their fit leaves."""
    n, d = tau.shape
    sizes = np.where(tau.std(axis=0) > 0, tau.std(axis=0), 1.0) if driven else np.ones(d)
    weighted = (columns.reshape(n, d, -1) / sizes[:, None]).reshape(n * d, -1)
    solution = least_squares.solve(weighted, (tau / sizes).ravel(), rank_tolerance=RANK, negligible=1e-9)
    if not driven:
        return solution.rank, columns.shape[1], solution.condition, None
    left = tau - (columns @ solution.x).reshape(n, d)
    own = np.split(solution.x[-3 * d :], d)
    friction = np.stack([block @ own[joint] for joint, block in enumerate(_friction_columns(qd))], axis=1)
    viscous, coulomb = np.array(own)[:, :2].T
    explained = 1 - left.var(axis=0) / np.maximum(tau.var(axis=0), np.finfo(float).tiny)
    seen = FrictionSeen(chosen, left + friction, viscous, coulomb, _scales(qd), explained)
    return solution.rank, columns.shape[1], solution.condition, seen


def _with_friction(columns: np.ndarray, friction: list[np.ndarray]) -> np.ndarray:
    """The regressor with viscous, dry friction and offset of each joint [n d, P]."""
    d = len(friction)
    own = np.zeros((len(columns), d, 3 * d))
    for joint, block in enumerate(friction):
        own[:, joint, 3 * joint : 3 * joint + 3] = block
    return np.concatenate([columns, own], axis=2).reshape(len(columns) * d, -1)


def _signs(
    correlation: np.ndarray, signs: np.ndarray, estimate: np.ndarray, tilt: float, down: np.ndarray
) -> list[Finding]:
    """Torques that point the other way, or gravity that does."""
    weights = signs[:, 1]
    if estimate @ down < 0 and (weights < 0).any() and not (weights > 0).any() and not (signs[:, 0] < 0).any():
        said = f"gravity pulls the other way: the data say {_rounded(estimate)} m/s²"
        remedy = "turn gravity round in the description, or see how the arm is mounted and where its joints have zero"
        return [Finding("error", "gravity", said, remedy)]
    flipped = np.flatnonzero(correlation < -RELATED)
    if len(flipped):
        said = f"the torque of {named(flipped)} has the opposite sign of the tree's"
        return [Finding("error", "tree-sign", said, "turn that tau or that q round", tuple(map(int, flipped)))]
    if tilt > TILTED:
        said = f"gravity is tilted by {tilt:.0f} degrees: the data say {_rounded(estimate)} m/s²"
        return [Finding("error", "gravity", said, "state how the base is mounted, or see where joints have zero")]
    return []


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


def _by_joint(forces: _Forces, down: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scale and correlation of each torque to the tree's, friction apart; and signs of both its parts [d, 2].

    A sign is 0 where the part makes no difference.
    """
    weight = forces.gravity @ down
    scale, correlation, signs = [], [], []
    for joint, columns in enumerate(forces.friction):
        basis = np.linalg.qr(columns)[0]
        of_joint = (forces.inertial[:, joint], weight[:, joint], forces.measured[:, joint])
        inertial, gravity, measured = (x - basis @ (basis.T @ x) for x in of_joint)
        both = inertial + gravity
        sizes = float(both @ both), float(measured @ measured)
        known = min(sizes) > 0
        scale.append(float(both @ measured) / sizes[0] if known else np.nan)
        correlation.append(float(both @ measured) / np.sqrt(sizes[0] * sizes[1]) if known else 0.0)
        pair = np.column_stack([inertial, gravity])
        fit = np.linalg.lstsq(pair, measured, rcond=1e-10)[0]
        error = max(float(np.sum((measured - pair @ fit) ** 2)), 1e-12 * sizes[1], np.finfo(float).tiny)
        seen = []
        for part in range(2):
            other, own = pair[:, 1 - part], pair[:, part]
            own = own - other * (other @ own) / max(float(other @ other), np.finfo(float).tiny)
            seen.append(float(np.sign(fit[part])) if fit[part] ** 2 * (own @ own) / error > SEEN else 0.0)
        signs.append(seen)
    return np.array(scale), np.array(correlation), np.array(signs)


def _gravity(forces: _Forces, down: np.ndarray) -> tuple[np.ndarray, float]:
    """The gravity that explains all joints' torques best, and its angle to the tree's in degrees, 0 where unsure."""
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
    if not rows:
        return np.full(3, np.nan), 0.0
    A, b = np.concatenate(rows), np.concatenate(rhs)
    free = least_squares.solve(A, b, rank_tolerance=1e-6, negligible=1e-9)
    described = least_squares.solve(np.column_stack([A[:, 0], A[:, 1:] @ down]), b, negligible=1e-9)
    estimate = free.x[1:]
    length = float(np.linalg.norm(estimate) * np.linalg.norm(down))
    if length == 0 or free.residual**2 > TILT_EXPLAINS * described.residual**2:
        return estimate, 0.0
    return estimate, float(np.degrees(np.arccos(np.clip(estimate @ down / length, -1, 1))))
