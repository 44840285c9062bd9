"""Runs all checks on a log and collects findings and intermediate results."""

from typing import NamedTuple

import numpy as np

from dln_jax.data.checks.channels import check_channels
from dln_jax.data.checks.derivatives import check_derivatives
from dln_jax.data.checks.findings import Finding, by_severity
from dln_jax.data.checks.hypotheses import Torques, examine_torques
from dln_jax.data.checks.recording import Recording, as_recording
from dln_jax.data.checks.repaired import any_energy
from dln_jax.data.checks.times import check_times
from dln_jax.data.checks.torques import check_degrees, check_torques
from dln_jax.data.checks.tree import OnTree, against_tree
from dln_jax.data.encoders.repeats import Repeats, without_repeats
from dln_jax.data.encoders.sampling import step_of
from dln_jax.data.encoders.smoothing import Smoothed, smooth
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.types import InputError

FARTHEST = 0.1
"""s: largest delay between q and tau tested; at most `MOST_SHIFTS` samples."""
MOST_SHIFTS = 20
EQUATIONS = 1000
"""Number of torques, over all joints, used to search for faults."""
FEWER, FEWER_EACH = 300, 100
"""Smaller numbers for `quick`: the minimum over all joints, and the number per joint."""
BLINDING = ("saturation-tau", "saturation-q", "dead-torque", "constant-torque", "unexcited")
"""Without a robot, torques are not examined if one of these findings is present."""
ESTIMATED = "--cutoff auto, or data.encoders.smooth(), filters q before rates are derived"


class Examination(NamedTuple):
    """Findings, and the intermediate results behind them."""

    findings: list[Finding]
    """Most severe first."""
    recording: Recording
    smoothed: Smoothed | None
    """The log with rates of filtered coordinates; `None` if no segment is long enough."""
    regression: Torques | None
    """Examination of the torques without a robot; `None` without torques, with too few samples, or with a robot."""
    on_tree: OnTree | None
    """Comparison with the robot's description; `None` without one."""
    steps: np.ndarray
    """Encoder resolution, rad or m [d]; zero for channels without steps."""


def quick(data: Trajectories, robot: Robot | None = None) -> list[Finding]:
    """Runs all checks on fewer torques, in a few seconds; arguments as `examine`."""
    return examine(as_recording(data), robot, equations=quick_equations(data.degrees_of_freedom)).findings


def quick_equations(d: int) -> int:
    """Number of torques, over all d joints, that `quick` uses to search for faults."""
    return max(FEWER, FEWER_EACH * d)


def examine(recording: Recording, robot: Robot | None = None, *, equations: int = EQUATIONS) -> Examination:
    """Runs all checks.

    Args:
        recording: the log.
        robot: description of the robot, with the joints of the data.
        equations: number of torques, over all joints, used to search for faults of sign, order and delay.

    Raises:
        InputError: the robot has another number of joints than the data.
    """
    data = recording.data
    d = data.degrees_of_freedom
    joints = data.needs.joints if data.needs is not None else ("revolute",) * d
    if robot is not None:
        joints = robot.tree.joints
        if len(joints) != d:
            raise InputError(
                f"the robot has {len(joints)} joints, but the data have {d}; lock those that do not move: "
                "--lock NAME,NAME"
            )
    findings = [*recording.repaired, *check_times(data)]
    data, repeats = without_repeats(data)
    findings += _repeated(repeats)
    even = _even(data)
    findings += check_channels(recording.data, None if even is None else even.data.qd)
    regression = None
    driven = "tau" not in data.estimated and bool(np.ptp(data.tau, axis=0).any())
    if even is not None:
        findings += _noise(data, even)
        findings += check_derivatives(data, even)
        findings += check_degrees(even.data, joints, driven=driven)
        # Wrong units, and channels that are clipped or dead, make the signs of torques inconclusive.
        sound = not any(each.severity == "error" or each.check in BLINDING for each in findings)
        if driven and sound and robot is None and plain(data):
            regression = examine_torques(
                even.data, any_energy(tuple(joints)), farthest=_farthest(even), equations=equations, ambiguous=True
            )
        if regression is not None:
            stated = data.needs is not None and bool(data.needs.friction or data.needs.joint_friction)
            findings += check_torques(even.data, regression, friction_stated=stated)
    on_tree = None
    if robot is not None:
        samples = even.data if even is not None else data
        farthest = 0 if even is None else _farthest(even)
        on_tree = against_tree(samples, robot, recording.names, driven=driven, farthest=farthest, equations=equations)
        findings += on_tree.findings
    return Examination(by_severity(findings), recording, even, regression, on_tree, step_of(recording.data.q))


def plain(data: Trajectories) -> bool:
    """Whether tau acts on the coordinates directly, with one motor per joint."""
    needs = data.needs
    passive = not np.ptp(data.tau, axis=0).all()
    return not passive and (needs is None or (needs.actuation is None and needs.joint_map is None))


def _repeated(repeats: Repeats) -> list[Finding]:
    count = int((repeats.q | repeats.tau).sum())
    if not count:
        return []
    kinds = {"rows": repeats.rows, "q": repeats.q & ~repeats.rows, "tau": repeats.tau & ~repeats.rows}
    counted = ", ".join(f"{int(where.sum())} of {name}" for name, where in kinds.items() if where.any())
    why = "the log is faster than its source" if repeats.inserted else "messages were lost"
    said = f"{count} sample(s) repeat the one before while the robot moves ({counted}): {why}"
    return [Finding("warning", "repeated", said, "resample over them with smooth() or --cutoff auto")]


def _farthest(even: Smoothed) -> int:
    return int(np.clip(round(FARTHEST * even.rate), 2, MOST_SHIFTS))


def _even(data: Trajectories) -> Smoothed | None:
    try:
        return smooth(data, trim=0.0)
    except InputError:  # single states, or motions of a few samples: their rates cannot be checked
        return None


def _noise(data: Trajectories, even: Smoothed) -> list[Finding]:
    """Reports accelerations from unfiltered differences of a noisy q."""
    estimated = [key for key in ("qd", "qdd") if key in data.estimated]
    if not estimated or np.isinf(even.cutoff) or even.choice is None:
        return []
    amplified = even.noise_q * (even.rate * np.sqrt(6) / 4)  # of central differences taken twice: sqrt(6) / (4 dt²)
    share = amplified * even.rate / np.maximum(even.data.qdd.std(axis=0), np.finfo(float).tiny)
    if share.max() < 0.05:
        return []
    said = f"accelerations by differences of this q are noise to {100 * share.max():.0f} % of their size"
    return [Finding("warning", "raw-differences", said, ESTIMATED)]
