"""Formats an examination as a page of text: the log, a table of joints, and the findings."""

import numpy as np

from dln_jax.data.checks.validation import Examination
from dln_jax.data.encoders import sampling

WIDTH = 10


def report(examined: Examination, name: str) -> list[str]:
    """Lines of text; findings come last, most severe first."""
    data = examined.recording.data
    count = len(np.unique(data.trajectory))
    lines = [f"{name}: {len(data.t)} samples of {count} trajectories, {data.degrees_of_freedom} joints"]
    if examined.smoothed is not None:
        timing = sampling.timing(data.t, data.trajectory)
        lines.append(f"{timing.rate:.4g} Hz, steps vary by {timing.jitter:.1%}, {timing.gaps} gaps")
        cutoff = examined.smoothed.cutoff
        lines.append(
            "noise of q is too small to be filtered"
            if np.isinf(cutoff)
            else f"a low-pass of q is best at about {cutoff:.3g} Hz (--cutoff auto)"
        )
    lines += ["", *_table(examined), ""]
    on_tree = examined.on_tree
    if on_tree is not None:
        lines.append(
            f"robot: the motions determine {on_tree.rank} of {on_tree.parameters} parameters, with friction's (some "
            f"are never determined alone); condition {on_tree.condition:.3g}"
        )
        lines.append("")
    torques = on_tree.torques if on_tree is not None else examined.regression
    if torques is not None:
        by = "parameters near the robot's" if on_tree is not None else "an energy of any arm and friction"
        lines.append(
            f"torques: {by} predict blocks that were left out to {torques.explained.mean():.1%}; the likeliest delay "
            f"is {torques.likely_delay:.2f} samples"
        )
    elif "tau" not in data.estimated:
        lines.append("torques: signs, order of columns and delay cannot be checked in this log")
    if not examined.findings:
        lines.append("nothing was found")
    return [*lines, *(finding.line for finding in examined.findings)]


def _table(examined: Examination) -> list[str]:
    data, smoothed, regression, on_tree = (
        examined.recording.data, examined.smoothed, examined.regression, examined.on_tree
    )  # fmt: skip
    columns: list[tuple[str, str, np.ndarray]] = [
        ("q from", "rad|m", data.q.min(axis=0)),
        ("to", "rad|m", data.q.max(axis=0)),
        ("step", "rad|m", examined.steps),
    ]
    if smoothed is not None:
        columns.append(("noise q", "rad|m", smoothed.noise_q))
        columns.append(("max |qd|", "1/s", np.abs(smoothed.data.qd).max(axis=0)))
    if "tau" not in data.estimated:
        columns.append(("max |tau|", "N m|N", np.abs(data.tau).max(axis=0)))
        if smoothed is not None:
            columns.append(("noise tau", "N m|N", smoothed.noise_tau))
    regression = on_tree.torques if on_tree is not None else regression
    if regression is not None:
        columns.append(("viscous", "N m s", regression.viscous))
        columns.append(("dry", "N m|N", regression.coulomb))
    if on_tree is not None and np.isfinite(on_tree.scale).any():
        columns.append(("tau/robot", "1", on_tree.scale))
    head = "joint" + "".join(f"{title:>{WIDTH}}" for title, _, _ in columns)
    units = "     " + "".join(f"{unit:>{WIDTH}}" for _, unit, _ in columns)
    rows = [
        f"{joint + 1:5d}" + "".join(f"{values[joint]:{WIDTH}.3g}" for _, _, values in columns)
        for joint in range(data.degrees_of_freedom)
    ]
    return [head, units, *rows]
