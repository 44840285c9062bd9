"""Validates a log, and writes the findings into a folder."""

import contextlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from dln_jax.data.checks.report import Examination, examine, read, report
from dln_jax.data.robots import read_robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import with_joints
from dln_jax.figures.logs import log_figure
from dln_jax.files import write_bytes, write_figure, write_json
from dln_jax.runs.arguments import names_listed, refuse_given
from dln_jax.runs.logs import facts
from dln_jax.runs.stored_arguments import command_folder
from dln_jax.types import InputError


def validate(options: Any) -> None:
    """Examines the log, prints and writes the findings; exits with status 1 if there is an error among them."""
    if options.robot is None:
        refuse_given(options, ["lock"], "for joints of --robot")
    robot = None if options.robot is None else read_robot(options.robot, lock=names_listed(options.lock))
    names = () if robot is None else robot.tree.names
    data, repaired = read(options.data, **facts(options), robot=names)
    examined = examine(for_robot(data, names), robot, repaired=repaired)
    lines = report(examined, str(options.data))
    with command_folder(options, "check_data") as folder:
        print("\n".join(lines))
        write_bytes(folder / "report.txt", ("\n".join(lines) + "\n").encode())
        write_json(folder / "findings.json", {"findings": [finding._asdict() for finding in examined.findings]})
        write_json(folder / "metrics.json", metrics(examined))
        if options.figures:
            write_figure(folder / "log.png", log_figure(examined))
        print(f"folder: {folder}")
    if any(finding.severity == "error" for finding in examined.findings):
        raise SystemExit(1)


def for_robot(data: Trajectories, names: Sequence[str]) -> Trajectories:
    """The log with the robot's joints, if their names match; else unchanged, which the checks then report."""
    if not names or data.joint_names is None or set(names) == set(data.joint_names):
        return data
    with contextlib.suppress(InputError):
        return with_joints(data, names)
    return data


def metrics(examined: Examination) -> dict[str, Any]:
    """Metrics of the examination, for metrics.json."""
    severities = [finding.severity for finding in examined.findings]
    numbers: dict[str, Any] = {f"{kind}s": severities.count(kind) for kind in ("error", "warning")}
    smoothed, on_tree, torques = examined.smoothed, examined.on_tree, examined.torques
    if smoothed is not None:
        numbers |= {"rate_hz": smoothed.rate, "noise_q_max": float(np.max(smoothed.noise_q))}
        numbers |= {"cutoff_hz": smoothed.cutoff} if np.isfinite(smoothed.cutoff) else {}
    if on_tree is not None:
        numbers |= {"rank": on_tree.rank, "condition": on_tree.condition}
    if torques is not None:
        numbers |= {"delay_samples": torques.likely_delay, "unexplained": float(1 - torques.explained.mean())}
    return numbers
