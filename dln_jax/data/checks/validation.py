"""Reads a log tolerantly, runs all checks on it, and formats the findings as a page of text."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dln_jax.data import schema
from dln_jax.data.checks.channels import FILTER, check_channels, check_times
from dln_jax.data.checks.derivatives import check_derivatives
from dln_jax.data.checks.energies import any_energy
from dln_jax.data.checks.findings import Finding, by_severity
from dln_jax.data.checks.hypotheses import Torques, examine_torques
from dln_jax.data.checks.joints import check_degrees, check_torques
from dln_jax.data.checks.tree import OnTree, against_tree
from dln_jax.data.encoders.clock import clock_line
from dln_jax.data.encoders.repeats import Repeats, without_repeats
from dln_jax.data.encoders.sampling import step_of, timing
from dln_jax.data.encoders.smoothing import Smoothed, smooth
from dln_jax.data.repeated_motions import motion_numbers
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.types import InputError

FARTHEST = 0.25
"""s: largest delay between q and tau tested; at most `MOST_SHIFTS` samples."""
MOST_SHIFTS = 20
EQUATIONS, EACH = 300, 100
"""Number of torques used to search for faults: the minimum over all joints, and the number per joint."""
BLINDING = ("saturation-tau", "saturation-q", "dead-torque", "constant-torque", "unexcited")
"""Without a robot, torques are not examined if one of these findings is present."""
WIDTH = 10
"""Characters per column of the report's table."""
ESTIMATED = "--cutoff auto, or data.encoders.smooth(), filters q before rates are derived"


class Recording(NamedTuple):
    """Trajectories in order of time, with findings on repairs."""

    data: Trajectories
    repaired: tuple[Finding, ...] = ()


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

    @property
    def torques(self) -> Torques | None:
        """Examination of the torques, with the robot if there is one."""
        return self.regression if self.on_tree is None else self.on_tree.torques


def as_recording(data: Trajectories) -> Recording:
    """Wraps trajectories that have already been read."""
    return Recording(data)


def read(path: str | Path, **stated: Any) -> Recording:
    """Reads a file as `schema.load` does, but repairs and reports samples out of order and duplicates."""
    return schema.load_arrays(path, _from_arrays, **stated)


def _from_arrays(arrays: dict[str, Any]) -> Recording:
    kept, repaired = _in_order(arrays)
    return Recording(schema.from_arrays(kept), repaired)


def _in_order(arrays: dict[str, Any]) -> tuple[dict[str, Any], tuple[Finding, ...]]:
    """Groups samples by trajectory, sorts them by time and drops duplicates after the first."""
    t, trajectory = (np.asarray(arrays.get(key, np.zeros(0))) for key in ("t", "trajectory"))
    if t.ndim != 1 or t.shape != trajectory.shape or not np.issubdtype(t.dtype, np.number) or not len(t):
        return arrays, ()  # the schema refuses them
    order = np.lexsort((t, trajectory))
    same = np.r_[False, (np.diff(t[order]) == 0) & (np.diff(trajectory[order]) == 0)]
    backward, double = int(np.sum(np.diff(t)[np.diff(trajectory) == 0] < 0)), int(same.sum())
    repeated, first = f"{double} sample(s) have the time of the one before", "keep one sample for each time"
    cases = (
        (backward, "time-order", f"t decreases at {backward} sample(s)", "sort each trajectory by time (done here)"),
        (double, "time-double", repeated, f"{first} (the first was kept here)"),
    )
    repaired = tuple(Finding("error", check, text, remedy) for count, check, text, remedy in cases if count)
    if not repaired:
        return arrays, ()
    kept = order[~same]
    return {
        key: np.asarray(array)[kept]
        if np.shape(array)[:1] == (len(t),) and key not in ("label", "joint_names")
        else array
        for key, array in arrays.items()
    }, repaired


def quick(data: Trajectories, robot: Robot | None = None) -> list[Finding]:
    """Findings of all checks, most severe first; arguments as for `examine`."""
    return examine(as_recording(data), robot).findings


def examine(recording: Recording, robot: Robot | None = None) -> Examination:
    """Runs all checks.

    Args:
        robot: description of the robot, with the joints of the data.

    Raises:
        InputError: the robot and the data have different numbers of joints.
    """
    data = recording.data
    d, needs = data.degrees_of_freedom, data.needs
    equations = max(EQUATIONS, EACH * d)
    joints = needs.joints if needs is not None else ("revolute",) * d
    if robot is not None:
        joints = robot.tree.joints
        if len(joints) != d:
            raise InputError(
                f"the robot has {len(joints)} joints, but the data have {d}; lock those that do not move: "
                "--lock NAME,NAME"
            )
    findings = [*recording.repaired, *check_times(data), *_repeated_motions(data)]
    data, repeats = without_repeats(data)
    findings += _repeated(repeats)
    try:
        even = smooth(recording.data, trim=0.0)  # which removes the repeats itself, and knows where they were
    except InputError:  # single states, or motions of a few samples: their rates cannot be checked
        even = None
    if even is not None and even.clock is not None:
        findings = [finding for finding in findings if finding.check != "jitter"]
        findings.append(Finding("warning", "arrival", clock_line(even.clock), FILTER))
    findings += check_channels(recording.data, None if even is None else even.data.qd)
    driven = "tau" not in data.estimated and bool(np.ptp(data.tau, axis=0).any())
    farthest = 0 if even is None else int(np.clip(round(FARTHEST * even.rate), 2, MOST_SHIFTS))
    regression = on_tree = None
    if even is not None:
        findings += _noise(data, even)
        findings += check_derivatives(data, even)
        findings += check_degrees(even.data, joints, driven=driven)
        # Wrong units, and channels that are clipped or dead, make the signs of torques inconclusive.
        sound = not any(finding.severity == "error" or finding.check in BLINDING for finding in findings)
        if driven and sound and robot is None and _one_motor_per_joint(data):
            regression = examine_torques(
                even.data, any_energy(tuple(joints)), farthest=farthest, equations=equations, alone=True
            )
        if regression is not None:
            stated = needs is not None and bool(needs.friction or needs.joint_friction)
            findings += check_torques(even.data, regression, friction_stated=stated, with_robot=False)
    if robot is not None:
        samples = data if even is None else even.data
        names = () if data.joint_names is None else tuple(map(str, data.joint_names))
        on_tree = against_tree(samples, robot, names, driven=driven, farthest=farthest, equations=equations)
        findings += on_tree.findings
    return Examination(by_severity(findings), recording, even, regression, on_tree, step_of(recording.data.q))


def _one_motor_per_joint(data: Trajectories) -> bool:
    """Whether every torque varies and acts on its coordinate directly."""
    needs = data.needs
    varies = bool(np.ptp(data.tau, axis=0).all())
    return varies and (needs is None or (needs.actuation is None and needs.joint_map is None))


def _repeated(repeats: Repeats) -> list[Finding]:
    count = int((repeats.q | repeats.tau).sum())
    if not count:
        return []
    kinds = {"rows": repeats.rows, "q": repeats.q & ~repeats.rows, "tau": repeats.tau & ~repeats.rows}
    counted = ", ".join(f"{int(where.sum())} of {name}" for name, where in kinds.items() if where.any())
    why = "the log is faster than its source" if repeats.inserted else "messages were lost"
    observation = f"{count} sample(s) repeat the one before while the robot moves ({counted}): {why}"
    return [Finding("warning", "repeated", observation, "resample over them with smooth() or --cutoff auto")]


def _repeated_motions(data: Trajectories) -> list[Finding]:
    recordings, numbers = len(np.unique(data.trajectory)), motion_numbers(data.q, data.trajectory)
    motions = len(np.unique(numbers[numbers >= 0]))
    if motions == recordings:
        return []
    observation = f"{recordings} recordings show {motions} motion{'s' * (motions > 1)}"
    remedy = "errors on other motions are known only if some are held out; record more of them"
    return [Finding("note", "repeated-motions", observation, remedy)]


def _noise(data: Trajectories, even: Smoothed) -> list[Finding]:
    """Reports accelerations from unfiltered differences of a noisy q."""
    estimated = any(key in data.estimated for key in ("qd", "qdd"))
    if not estimated or np.isinf(even.cutoff) or even.choice is None:
        return []
    amplified = even.noise_q * (even.rate * np.sqrt(6) / 4)  # of central differences taken twice: sqrt(6) / (4 dt²)
    share = amplified * even.rate / np.maximum(even.data.qdd.std(axis=0), np.finfo(float).tiny)
    if share.max() < 0.05:
        return []
    observation = f"accelerations by differences of this q have noise of {100 * share.max():.0f} % of their size"
    return [Finding("warning", "raw-differences", observation, ESTIMATED)]


def report(examined: Examination, name: str) -> list[str]:
    """Lines of text; findings come last, most severe first."""
    data, smoothed = examined.recording.data, examined.smoothed
    count = len(np.unique(data.trajectory))
    lines = [f"{name}: {len(data.t)} samples of {count} trajectories, {data.degrees_of_freedom} joints", *data.remarks]
    if smoothed is not None:
        steps = timing(data.t, data.trajectory)
        lines.append(f"{steps.rate:.4g} Hz, steps vary by {steps.jitter:.1%}, {steps.gaps} gaps")
        lines.append(
            "the noise of q is too small for a filter"
            if np.isinf(smoothed.cutoff)
            else f"the best low-pass of q has a cut-off of about {smoothed.cutoff:.3g} Hz (--cutoff auto)"
        )
    lines += ["", *_table(examined), ""]
    on_tree, torques = examined.on_tree, examined.torques
    if on_tree is not None:
        lines.append(
            f"robot: the motions determine {on_tree.rank} of {on_tree.parameters} parameters, friction included (some "
            f"are never determined alone); condition {on_tree.condition:.3g}"
        )
        lines.append("")
    if torques is not None:
        by = "parameters near the robot's" if on_tree is not None else "an energy of any arm and friction"
        lines.append(
            f"torques: {by} predict {torques.explained.mean():.1%} of the variance in left-out blocks; the likeliest "
            f"delay is {torques.likely_delay:.2f} samples"
        )
    elif "tau" not in data.estimated:
        lines.append("torques: signs, order of columns and delay cannot be checked in this log")
    if not examined.findings:
        lines.append("nothing was found")
    return [*lines, *(finding.line for finding in examined.findings)]


def _table(examined: Examination) -> list[str]:
    data, smoothed, on_tree, torques = (
        examined.recording.data, examined.smoothed, examined.on_tree, examined.torques
    )  # fmt: skip
    driven = "tau" not in data.estimated
    columns = [("q from", "rad|m", data.q.min(axis=0)), ("to", "rad|m", data.q.max(axis=0))]
    columns += [("step", "rad|m", examined.steps)]
    if smoothed is not None:
        columns += [("noise q", "rad|m", smoothed.noise_q)]
        columns += [("max |qd|", "1/s", np.abs(smoothed.data.qd).max(axis=0))]
    if driven:
        columns += [("max |tau|", "N m|N", np.abs(data.tau).max(axis=0))]
    if driven and smoothed is not None:
        columns += [("noise tau", "N m|N", smoothed.noise_tau)]
    if torques is not None:
        columns += [("viscous", "N m s", torques.viscous), ("dry", "N m|N", torques.coulomb)]
    if on_tree is not None and np.isfinite(on_tree.scale).any():
        columns += [("tau/robot", "1", on_tree.scale)]
    head = "joint" + "".join(f"{title:>{WIDTH}}" for title, _, _ in columns)
    units = "     " + "".join(f"{unit:>{WIDTH}}" for _, unit, _ in columns)
    rows = [
        f"{joint + 1:5d}" + "".join(f"{values[joint]:{WIDTH}.3g}" for _, _, values in columns)
        for joint in range(data.degrees_of_freedom)
    ]
    return [head, units, *rows]
