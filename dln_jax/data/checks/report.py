"""Formats an examination as a page of text: the log, a table of joints, and the findings."""

import numpy as np

from dln_jax.data.checks.validation import Examination
from dln_jax.data.encoders.sampling import timing

WIDTH = 10


def report(examined: Examination, name: str) -> list[str]:
    """Lines of text; findings come last, most severe first."""
    data, smoothed = examined.recording.data, examined.smoothed
    count = len(np.unique(data.trajectory))
    lines = [f"{name}: {len(data.t)} samples of {count} trajectories, {data.degrees_of_freedom} joints"]
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
