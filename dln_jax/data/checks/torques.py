"""Findings about torques: signs, columns, delay, friction, and angles that may be in degrees."""

import numpy as np

from dln_jax.data.checks.channels import TURNS
from dln_jax.data.checks.findings import Finding, named
from dln_jax.data.checks.hypotheses import Torques, examine_torques
from dln_jax.data.checks.repaired import any_energy
from dln_jax.data.schema import Trajectories

TRUSTED = 0.8
"""Fraction of a torque's variance that must be predicted before its friction is reported."""
DRY = 0.02
"""Smallest dry friction reported, relative to the torque's standard deviation."""
SURE = 5.0
"""Dry friction must exceed zero by this many standard deviations."""
FEWER = 300
"""Number of equations used to compare degrees with radians."""


def check_torques(data: Trajectories, found: Torques, *, friction_stated: bool, by: str = "") -> list[Finding]:
    """Turns the examination of torques into findings; `by` is non-empty if a robot's file was used."""
    log, findings = found.log, []
    before, after = (each.unexplained.mean() for each in (found.explanation, found.repaired))
    gain = f"unexplained in blocks left out: {before:.2%} now, {after:.2%} then"
    wrong = np.flatnonzero(log.signs < 0)
    if len(wrong):
        check = "tree-sign" if by else "torque-sign"
        said = f"the torque of {named(wrong)} has the wrong sign ({gain})"
        findings.append(Finding("error", check, said, "turn that tau or that q round", tuple(map(int, wrong))))
    if log.order != tuple(range(len(log.order))):
        moved = tuple(joint for joint, source in enumerate(log.order) if joint != source)
        order = ", ".join(str(source + 1) for source in log.order)
        said = f"the torques of {named(moved)} are exchanged: columns {order} of tau fit q ({gain})"
        findings.append(Finding("error", "order", said, "order the columns of tau as those of q", moved))
    if log.delay:
        step = 1e3 * float(np.median(np.diff(data.t)[np.diff(data.trajectory) == 0]))
        word = "late" if log.delay > 0 else "early"
        said = f"torques are {abs(log.delay) * step:.3g} ms {word} against positions ({gain})"
        findings.append(Finding("warning", "delay", said, "shift one of them in time, or repair the clock of the log"))
    elif not friction_stated and not findings:
        findings += _friction(found)
    return findings


def _friction(found: Torques) -> list[Finding]:
    size = found.log.torques().std(axis=0)
    sure = (found.explained > TRUSTED) & (found.coulomb > DRY * size) & (found.coulomb > SURE * found.coulomb_error)
    rubbing = np.flatnonzero(sure)
    if not len(rubbing):
        return []
    sizes = ", ".join(f"{found.coulomb[joint]:.2g}" for joint in rubbing)
    said = f"friction is seen at {named(rubbing)} (dry: about {sizes})"
    remedy = 'state it: --needs \'{"joints": [...], "joint_friction": ["viscous", "coulomb"]}\''
    return [Finding("note", "friction", said, remedy, tuple(map(int, rubbing)))]


def check_degrees(data: Trajectories, joints: tuple[str, ...], *, driven: bool) -> list[Finding]:
    """Reports angles so large that they may be in degrees, or motor angles."""
    largest = np.abs(data.q).max(axis=0)
    large = np.array([kind == "revolute" for kind in joints]) & (largest > TURNS)
    if not large.any():
        return []
    where = np.flatnonzero(large)
    factor = np.where(large, np.pi / 180, 1.0)
    converted = data._replace(q=data.q * factor, qd=data.qd * factor, qdd=data.qdd * factor)
    now, then = (_unexplained(each, joints) if driven else None for each in (data, converted))
    better = now is not None and then is not None and then < 0.7 * now
    if not better and largest.max() < 10 * TURNS:
        said = f"q of {named(where)} goes to {largest.max():.3g} rad, which is {largest.max() / 2 / np.pi:.1f} turns"
        remedy = "nothing if it turns on and on; else convert from degrees, or from the motor's angle by the gear ratio"
        return [Finding("note", "q-unit", said, remedy, tuple(map(int, where)))]
    said = f"q of {named(where)} goes to {largest.max():.3g}, far beyond two turns"
    remedy = "convert to radians if these are degrees, or divide by the gear ratio if they are the motor's"
    return [Finding("error", "q-unit", said, remedy, tuple(map(int, where)))]


def _unexplained(data: Trajectories, joints: tuple[str, ...]) -> float | None:
    found = examine_torques(data, any_energy(joints), farthest=0, equations=FEWER, ambiguous=False, faults=False)
    return None if found is None else float(found.explanation.unexplained.mean())
