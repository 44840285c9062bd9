"""Check a log before you train on it or identify a robot.

Checks sampling times, units, signs, qd and qdd against q, the delay between q and tau, saturation, encoder steps,
noise, joints that hardly move, and friction. With --robot it also checks gravity, gear ratios, the order and limits of
joints, and how well the motions determine the robot's parameters. Every finding comes with a remedy. The run folder
gets report.txt, findings.json and a figure with spectra and cut-off, delay, and torque against velocity. The exit
status is 1 if there are errors, and 0 if there are only warnings and notes.
"""

import contextlib
import math
from dataclasses import dataclass
from pathlib import Path

from dln_jax.errors import InputError
from dln_jax.options import Drawn, Folder, Logged, Unstated
from dln_jax.runs.arguments import names_listed, refuse_given


@dataclass(frozen=True, kw_only=True)
class Arguments(Folder, Drawn, Logged):
    """The log to validate."""

    data: Path
    """Log as npz, CSV or ROS bag: t and q, and optionally tau, qd, qdd and trajectory."""
    robot: Unstated[Path] = None
    """URDF or MJCF file of the robot (needs MuJoCo)."""
    lock: Unstated[str] = None
    """Comma-separated joints that do not move, such as those of a gripper; "*finger*" matches all names that contain
    finger (default: all move)."""


def main(options: Arguments) -> None:
    """Examines the log, prints and writes the findings; exits with status 1 if there is an error among them."""
    from dln_jax.data.checks.report import examine, read, report
    from dln_jax.data.robots import read_robot
    from dln_jax.data.splits import with_joints
    from dln_jax.figures.logs import log_figure
    from dln_jax.files import write_bytes, write_json
    from dln_jax.runs.arguments import facts
    from dln_jax.runs.folder import command_folder
    from dln_jax.runs.report import Report, finish, png

    if options.robot is None:
        refuse_given(options, ["lock"], "for joints of --robot")
    robot = None if options.robot is None else read_robot(options.robot, lock=names_listed(options.lock))
    names = () if robot is None else robot.tree.names
    data, repaired = read(options.data, **facts(options), robot=names)
    own = data.joint_names
    if names and own is not None and set(names) != set(own):
        with contextlib.suppress(InputError):  # the checks report names that do not match
            data = with_joints(data, names)
    examined = examine(data, robot, repaired=repaired)
    severities = [finding.severity for finding in examined.findings]
    metrics = {"errors": severities.count("error"), "warnings": severities.count("warning")}
    smoothed, on_tree, torques = examined.smoothed, examined.on_tree, examined.torques
    if smoothed is not None:
        metrics |= {"rate_hz": smoothed.rate, "noise_q_max": float(smoothed.noise_q.max())}
        metrics |= {"cutoff_hz": smoothed.cutoff} if math.isfinite(smoothed.cutoff) else {}
    if on_tree is not None:
        metrics |= {"rank": on_tree.rank, "condition": on_tree.condition}
    if torques is not None:
        metrics |= {"delay_samples": torques.likely_delay, "unexplained": float(1 - torques.explained.mean())}
    lines = tuple(report(examined, str(options.data)))
    with command_folder(options, "check_data") as folder:
        write_bytes(folder / "report.txt", ("\n".join(lines) + "\n").encode())
        write_json(folder / "findings.json", {"findings": [finding._asdict() for finding in examined.findings]})
        figures = {"log.png": png(log_figure, examined)}
        finish(folder, options, Report(metrics, (), "", lines=lines, figures=figures))
    if "error" in severities:
        raise SystemExit(1)
