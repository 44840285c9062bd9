"""Findings about joints: names, limits, angles in degrees, and signs, columns, delay and friction of their torques."""

from collections.abc import Callable

import numpy as np

from dln_jax.data.checks.channels import TURNS
from dln_jax.data.checks.energies import any_energy
from dln_jax.data.checks.findings import Finding, on_joints
from dln_jax.data.checks.hypotheses import Torques, examine_torques
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories

TOLERANCE = 0.05
"""rad or m: tolerance beyond a limit."""
EXPLAINED = 0.02
"""If less than this fraction of the torques' variance is unexplained, their order counts as correct."""
BETTER = 0.3
"""Another order of the joints must lower the unexplained variance to this fraction."""
TRUSTED = 0.8
"""Fraction of a torque's variance that must be predicted before its friction is reported."""
DRY = 0.02
"""Smallest dry friction reported, relative to the torque's standard deviation."""
SURE = 5.0
"""Dry friction must exceed zero by this many standard deviations."""
FEWER = 300
"""Number of equations used to compare degrees with radians."""


def check_torques(data: Trajectories, torques: Torques, *, friction_stated: bool, with_robot: bool) -> list[Finding]:
    """Turns the examination of torques into findings."""
    log = torques.log
    findings = on_joints(
        "error", "tree-sign" if with_robot else "torque-sign", log.signs < 0,
        f"the torque of {{}} has the wrong sign ({torques.gain})", "change the sign of that tau or that q",
    )  # fmt: skip
    columns = ", ".join(str(source + 1) for source in log.order)
    findings += on_joints(
        "error", "order", np.array(log.order) != np.arange(len(log.order)),
        f"the torques of {{}} are exchanged: columns {columns} of tau fit q ({torques.gain})",
        "order the columns of tau as those of q",
    )  # fmt: skip
    if log.delay:
        step = 1e3 * float(np.median(np.diff(data.t)[np.diff(data.trajectory) == 0]))
        late = f"{abs(log.delay) * step:.3g} ms {'late' if log.delay > 0 else 'early'}"
        observation = f"torques are {late} relative to positions ({torques.gain})"
        remedy = "shift one of them in time, or correct the clock of the log"
        findings.append(Finding("warning", "delay", observation, remedy))
    elif not friction_stated and not findings:
        size = log.torques().std(axis=0)
        sure = (torques.explained > TRUSTED) & (torques.coulomb > np.maximum(DRY * size, SURE * torques.coulomb_error))
        sizes = ", ".join(f"{dry:.2g}" for dry in torques.coulomb[sure])
        findings += on_joints(
            "note", "friction", sure, f"friction is seen at {{}} (dry: about {sizes})",
            'state it: --needs \'{"joints": [...], "joint_friction": ["viscous", "coulomb"]}\'',
        )  # fmt: skip
    return findings


def check_degrees(data: Trajectories, joints: tuple[str, ...], *, driven: bool) -> list[Finding]:
    """Reports angles so large that they may be in degrees, or motor angles."""
    largest = np.abs(data.q).max(axis=0)
    large = np.array([kind == "revolute" for kind in joints]) & (largest > TURNS)
    if not large.any():
        return []
    factor = np.where(large, np.pi / 180, 1.0)
    converted = data._replace(q=data.q * factor, qd=data.qd * factor, qdd=data.qdd * factor)
    now, then = (_unexplained(log, joints) if driven else None for log in (data, converted))
    better = now is not None and then is not None and then < 0.7 * now
    if better or largest.max() >= 10 * TURNS:
        return on_joints(
            "error", "q-unit", large, f"q of {{}} goes to {largest.max():.3g}, far beyond two turns",
            "convert to radians if these are degrees, or divide by the gear ratio if they are the motor's",
        )  # fmt: skip
    return on_joints(
        "note", "q-unit", large,
        f"q of {{}} goes to {largest.max():.3g} rad, which is {largest.max() / 2 / np.pi:.1f} turns",
        "ignore this if the joint turns without limit; else convert from degrees, or divide by the gear ratio",
    )  # fmt: skip


def _unexplained(data: Trajectories, joints: tuple[str, ...]) -> float | None:
    torques = examine_torques(data, any_energy(joints), farthest=0, equations=FEWER, faults=False)
    return None if torques is None else float(torques.explanation.unexplained.mean())


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
