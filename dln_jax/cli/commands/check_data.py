"""Examine a log before it is learned from: what is wrong with it, and what to do about it.

Looks at rates, gaps and the order of times, units, signs, qd and qdd against q, delay between q and tau, saturation,
steps of encoders, noise, unexcited joints and friction; with --robot also at gravity, gears, the order and limits of
joints, and how well the motions determine the robot's parameters. Prints a report, and writes it as report.txt, the
findings as findings.json, and a figure: spectra and cut-off, delay, and torque against velocity. The exit status is 1
if an error was found, and 0 if there are only warnings and notes.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.cli.arguments import Unstated, names_listed, refuse_given
from dln_jax.cli.options import Drawn, Folder, Logged
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.data.checks import Examination, examine, read, report
from dln_jax.data.robots import read_robot
from dln_jax.figures.logs import log_figure
from dln_jax.files import write_bytes, write_figure, write_json


@dataclass(frozen=True, kw_only=True)
class Arguments(Folder, Drawn, Logged):
    """The log to examine."""

    data: Path
    """Log as npz or CSV: t and q, and tau, qd, qdd and trajectory where there are any."""
    robot: Unstated[Path] = None
    """URDF or MJCF of the robot (needs MuJoCo)."""
    lock: Unstated[str] = None
    """Joints of the robot that do not move, such as those of a gripper, comma separated; "*finger*" names all with
    finger in their name (default: all joints move)."""


def main(given: Arguments) -> None:
    """Examines the log, prints and writes the findings; exits with status 1 if there is an error among them."""
    recording = read(given.data, rate=given.rate, units=given.units)
    if given.robot is None:
        refuse_given(given, ["lock"], "for joints of --robot")
    robot = None if given.robot is None else read_robot(given.robot, lock=names_listed(given.lock))
    examined = examine(recording, robot)
    lines = report(examined, str(given.data))
    with command_folder(given, "check_data") as folder:
        print("\n".join(lines))
        write_bytes(folder / "report.txt", ("\n".join(lines) + "\n").encode())
        write_json(folder / "findings.json", {"findings": [each._asdict() for each in examined.findings]})
        write_json(folder / "metrics.json", metrics(examined))
        if given.figures:
            write_figure(folder / "log.png", log_figure(examined))
        print(f"folder: {folder}")
    if any(finding.severity == "error" for finding in examined.findings):
        raise SystemExit(1)


def metrics(examined: Examination) -> dict[str, Any]:
    """Metrics of the examination, for metrics.json."""
    counted = {f"{kind}s": sum(each.severity == kind for each in examined.findings) for kind in ("error", "warning")}
    smoothed, regression, on_tree = examined.smoothed, examined.regression, examined.on_tree
    numbers: dict[str, Any] = dict(counted)
    if smoothed is not None:
        numbers |= {"rate_hz": smoothed.rate, "noise_q_max": float(np.max(smoothed.noise_q))}
        numbers |= {"cutoff_hz": smoothed.cutoff} if np.isfinite(smoothed.cutoff) else {}
    if on_tree is not None:
        numbers |= {"rank": on_tree.rank, "condition": on_tree.condition}
    torques = on_tree.torques if on_tree is not None else regression
    if torques is not None:
        numbers |= {"delay_samples": torques.likely_delay, "unexplained": float(1 - torques.explained.mean())}
    return numbers
