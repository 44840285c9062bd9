"""Reads a log tolerantly, runs all checks on it, and formats the findings as a page of text."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dln_jax.data import schema
from dln_jax.data.checks.channels import (
    FARTHEST,
    FILTER,
    SEVERITIES,
    Finding,
    check_channels,
    check_derivatives,
    check_times,
    findings_of,
)  # fmt: skip
from dln_jax.data.checks.priors import any_energy
from dln_jax.data.checks.torques import Torques, check_degrees, check_torques, examine_torques
from dln_jax.data.checks.tree import OnTree, compare_with_tree
from dln_jax.data.encoders.sampling import noise_of, step_of, timing, without_repeats
from dln_jax.data.encoders.smoothing import Smoothed, smooth
from dln_jax.data.repeated_motions import motion_numbers
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.types import InputError

MOST_SHIFTS = 20
"""Largest delay between q and tau tested, in samples."""
EQUATIONS, EACH = 300, 100
"""Number of torques in the search for faults: the minimum over all joints, and the number per joint."""
BLINDING = ("saturation-tau", "saturation-q", "dead-torque", "constant-torque", "unexcited")
"""Findings that rule out an examination of the torques without a robot."""
WIDTH = 10
"""Characters per column of the report's table."""
ESTIMATED = "--cutoff auto, or data.encoders.smoothing.smooth(), filters q before rates are derived"


class Examination(NamedTuple):
    """Findings with the results behind them."""

    findings: list[Finding]
    """Most severe first."""
    data: Trajectories
    smoothed: Smoothed | None
    """The log with rates of filtered coordinates; `None` if no segment is long enough."""
    torques: Torques | None
    """Examination of the torques, with the robot if there is one; `None` without torques or with too few samples."""
    on_tree: OnTree | None
    """Comparison with the robot's description; `None` without one."""


def read(path: str | Path, **stated: Any) -> tuple[Trajectories, list[Finding]]:
    """Reads a file as `schema.load` does, but sorts samples by time, drops duplicates, and reports both."""
    findings: list[Finding] = []

    def repair(arrays: dict[str, Any]) -> dict[str, Any]:
        t, trajectory = (np.asarray(arrays.get(key, ())) for key in ("t", "trajectory"))
        if t.ndim != 1 or t.shape != trajectory.shape or t.dtype.kind not in "fiu" or not len(t):
            return arrays  # the schema refuses them
        backward = np.sum(np.diff(t)[np.diff(trajectory) == 0] < 0)
        order = np.lexsort((t, trajectory))
        first = np.r_[True, (np.diff(t[order]) != 0) | (np.diff(trajectory[order]) != 0)]
        findings.extend(findings_of(
            ("error", "time-order", backward > 0, f"t decreases at {backward} sample(s)",
             "sort each trajectory by time (done here)"),
            ("error", "time-double", not first.all(), f"{np.sum(~first)} sample(s) have the time of the one before",
             "keep one sample for each time (the first was kept here)"),
        ))  # fmt: skip
        return arrays | {
            key: np.asarray(array)[order[first]]
            for key, array in arrays.items()
            if findings and np.shape(array)[:1] == t.shape and key not in ("label", "joint_names")
        }

    return schema.load(path, **stated, repair=repair), findings


def quick(data: Trajectories, robot: Robot | None = None) -> list[Finding]:
    """Returns the findings of all checks, most severe first; arguments as for `examine`."""
    return examine(data, robot).findings


def examine(data: Trajectories, robot: Robot | None = None, *, repaired: Sequence[Finding] = ()) -> Examination:
    """Runs all checks.

    Args:
        data: the log before any filter.
        robot: description of the robot, with the joints of the data.
        repaired: findings of `read`.

    Raises:
        InputError: the robot and the data have different numbers of joints.
    """
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
    findings = [*repaired, *check_times(data)]
    distinct, repeats = without_repeats(data)
    kinds = {"rows": repeats.rows, "q": repeats.q & ~repeats.rows, "tau": repeats.tau & ~repeats.rows}
    counts = {name: int(where.sum()) for name, where in kinds.items() if where.any()}
    listed = ", ".join(f"{count} of {name}" for name, count in counts.items())
    why = "the log is faster than its source" if repeats.inserted else "messages were lost"
    recordings, numbers = len(np.unique(data.trajectory)), motion_numbers(data.q, data.trajectory)
    motions = len(np.unique(numbers[numbers >= 0]))
    findings += findings_of(
        ("note", "repeated-motions", motions != recordings,
         f"{recordings} recordings show {motions} motion{'s' * (motions > 1)}",
         "errors on other motions are known only if some are held out; record more of them"),
        ("warning", "repeated", bool(counts),
         f"{sum(counts.values())} sample(s) repeat the one before while the robot moves ({listed}): {why}",
         "resample over them with smooth() or --cutoff auto"),
    )  # fmt: skip
    try:
        even = smooth(data, trim=0.0)  # removes the repeats and records their places
    except InputError:  # too few samples to check rates
        even = None
    if even is not None and even.clock is not None:
        findings = [finding for finding in findings if finding.check != "jitter"]
        findings += findings_of(("warning", "arrival", True, even.clock.line, FILTER))
    findings += check_channels(data, None if even is None else even.data.qd)
    driven = "tau" not in data.estimated and bool(np.ptp(distinct.tau, axis=0).any())
    farthest = 0 if even is None else int(np.clip(round(FARTHEST * even.rate), 2, MOST_SHIFTS))
    torques = on_tree = None
    if even is not None:
        findings += [*_noise(distinct, even), *check_derivatives(distinct, even)]
        findings += check_degrees(even.data, joints, driven=driven)
        # With wrong units or clipped or dead channels, the signs of torques are inconclusive. Every torque must vary
        # and act on its coordinate directly.
        sound = not any(finding.severity == "error" or finding.check in BLINDING for finding in findings)
        direct = needs is None or (needs.actuation is None and needs.joint_map is None)
        if driven and sound and robot is None and direct and np.ptp(distinct.tau, axis=0).all():
            prior = any_energy(tuple(joints))
            torques = examine_torques(even.data, prior, farthest=farthest, equations=equations, alone=True)
        if torques is not None:
            stated = needs is not None and bool(needs.friction or needs.joint_friction)
            findings += check_torques(torques, friction_stated=stated, with_robot=False)
    if robot is not None:
        samples = distinct if even is None else even.data
        names = () if data.joint_names is None else tuple(map(str, data.joint_names))
        on_tree = compare_with_tree(samples, robot, names, driven=driven, farthest=farthest, equations=equations)
        findings += on_tree.findings
        torques = on_tree.torques
    findings.sort(key=lambda finding: SEVERITIES.index(finding.severity))
    return Examination(findings, data, even, torques, on_tree)


def _noise(data: Trajectories, even: Smoothed) -> list[Finding]:
    """Reports accelerations from unfiltered differences of a noisy q, or of a noisy measured qd."""
    source, noise = "q", even.noise_q * even.rate * np.sqrt(3) / 2  # of central differences: 1 / (sqrt(2) dt)
    if "qd" not in data.estimated:
        source, noise = "qd", noise_of(data.qd, data.trajectory)
    share = np.max(noise * even.rate / np.sqrt(2) / np.maximum(even.data.qdd.std(axis=0), np.finfo(float).tiny))
    noisy = "qdd" in data.estimated and np.isfinite(even.cutoff) and even.choice is not None and share >= 0.05
    observation = f"accelerations differenced from {source} are {100 * share:.0f} % noise"
    return findings_of(("warning", "raw-differences", noisy, observation, ESTIMATED))


def report(examined: Examination, name: str) -> list[str]:
    """Returns the lines of the report; findings come last, most severe first."""
    findings, data, smoothed, torques, on_tree = examined
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
    if on_tree is not None:
        determined = f"the motions determine {on_tree.rank} of {on_tree.parameters} parameters, friction included"
        lines += [
            f"robot: {determined} (some cannot be determined individually); condition {on_tree.condition:.3g}",
            "",
        ]
    if torques is not None:
        by = "a model near the robot's file" if on_tree is not None else "a generic arm model with friction"
        lines.append(
            f"torques: {by} explains {torques.explained.mean():.1%} of the variance in left-out blocks; the most "
            f"likely delay is {torques.likely_delay:.2f} samples"
        )
    elif "tau" not in data.estimated:
        lines.append("torques: this log does not allow a check of signs, column order and delay")
    if not findings:
        lines.append("no faults found")
    return [*lines, *(finding.line for finding in findings)]


def _table(examined: Examination) -> list[str]:
    _, data, smoothed, torques, on_tree = examined
    driven = "tau" not in data.estimated
    columns = [("q from", "rad|m", data.q.min(axis=0))]
    columns += [("to", "rad|m", data.q.max(axis=0)), ("step", "rad|m", step_of(data.q))]
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
