"""Checks of torques against motions without a robot's description: signs, delay, friction, degrees."""

import numpy as np

from dln_jax.data.checks.channels import TURNS
from dln_jax.data.checks.findings import Finding, named
from dln_jax.data.checks.surrogate import Surrogate, surrogate
from dln_jax.data.schema import Trajectories

TRUSTED = 0.8
"""Of the variance that the regression has to explain before its word counts."""
SEEN = 0.05
"""By so much the squared error grows without a term that is there."""
LATE = 2.0
"""Samples of delay that are worth a word: without a robot's description it is known to about one or two."""
LATE_GAIN = 1.04
"""By which the squared error falls with it."""
DRY = 0.02
"""Of a torque's standard deviation, from which dry friction is named."""


def check_torques(data: Trajectories, found: Surrogate, *, friction_stated: bool) -> list[Finding]:
    """What the regression tells of torques."""
    findings = []
    sure = found.explained > TRUSTED
    wrong = np.flatnonzero(sure & (found.inertia < 0) & (found.inertia_seen > SEEN))
    if len(wrong):
        said = f"the torque of {named(wrong)} points against its acceleration"
        findings.append(Finding("error", "torque-sign", said, "turn that tau or that q round", tuple(map(int, wrong))))
    if sure.any() and abs(found.delay) > LATE and found.delay_gain > LATE_GAIN:
        step = float(np.median(np.diff(data.t)[np.diff(data.trajectory) == 0]))
        word = "late" if found.delay > 0 else "early"
        said = f"torques are about {abs(found.delay) * step * 1e3:.2g} ms {word} against positions"
        findings.append(Finding("warning", "delay", said, "shift one of them in time, or repair the clock of the log"))
    elif not friction_stated:
        findings += _friction(data, found, sure)
    return findings


def _friction(data: Trajectories, found: Surrogate, sure: np.ndarray) -> list[Finding]:
    size = data.tau[found.rows].std(axis=0)
    positive = (found.coulomb > DRY * size) | (found.viscous * np.sqrt(np.mean(data.qd**2, axis=0)) > DRY * size)
    rubbing = np.flatnonzero(sure & positive & (found.friction_seen > 4 * SEEN))
    if not len(rubbing):
        return []
    sizes = ", ".join(f"{found.coulomb[joint]:.2g}" for joint in rubbing)
    said = f"friction is seen at {named(rubbing)} (dry: about {sizes})"
    remedy = 'state it: --needs \'{"joints": [...], "joint_friction": ["viscous", "coulomb"]}\''
    return [Finding("note", "friction", said, remedy, tuple(map(int, rubbing)))]


def check_degrees(data: Trajectories, joints: tuple[str, ...], now: Surrogate | None, farthest: int) -> list[Finding]:
    """Angles so large that they may be degrees, or those of motors; `now` is the regression as they are."""
    largest = np.abs(data.q).max(axis=0)
    large = np.array([kind == "revolute" for kind in joints]) & (largest > TURNS)
    if not large.any():
        return []
    where = np.flatnonzero(large)
    factor = np.where(large, np.pi / 180, 1.0)
    converted = data._replace(q=data.q * factor, qd=data.qd * factor, qdd=data.qdd * factor)
    then = None if now is None else surrogate(converted, joints, farthest=farthest)
    better = now is not None and then is not None and _unexplained(then) < 0.7 * _unexplained(now)
    if not better and largest.max() < 10 * TURNS:
        said = f"q of {named(where)} goes to {largest.max():.3g} rad, which is {largest.max() / 2 / np.pi:.1f} turns"
        remedy = "nothing if it turns on and on; else convert from degrees, or from the motor's angle by the gear ratio"
        return [Finding("note", "q-unit", said, remedy, tuple(map(int, where)))]
    said = f"q of {named(where)} goes to {largest.max():.3g}, far beyond two turns"
    remedy = "convert to radians if these are degrees, or divide by the gear ratio if they are the motor's"
    return [Finding("error", "q-unit", said, remedy, tuple(map(int, where)))]


def _unexplained(found: Surrogate) -> float:
    return float(np.mean(1 - np.maximum(found.explained, 0.0)))
