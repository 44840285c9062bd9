"""Findings about torques: signs, columns, delay, friction, and angles that may be in degrees."""

import numpy as np

from dln_jax.data.checks.channels import TURNS
from dln_jax.data.checks.energies import any_energy
from dln_jax.data.checks.findings import Finding, on_joints
from dln_jax.data.checks.hypotheses import Torques, examine_torques
from dln_jax.data.schema import Trajectories

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
    torques = examine_torques(data, any_energy(joints), farthest=0, equations=FEWER, ambiguous=False, faults=False)
    return None if torques is None else float(torques.explanation.unexplained.mean())
