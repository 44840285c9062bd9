"""Reads a log with its context (joints, robot, filter, findings of the check), and splits it into parts."""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from dln_jax.data import schema
from dln_jax.data.checks.channels import Finding
from dln_jax.data.checks.report import quick
from dln_jax.data.encoders.smoothing import Smoothed, labels_of_parts, smooth
from dln_jax.data.joints import TorqueFactor
from dln_jax.data.repeated_motions import motion_numbers, remark_on_repeats
from dln_jax.data.robots import Robot, read_robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import (
    BLOCKS,
    EVERY_SIXTH,
    LEAST_TRAJECTORIES,
    Split,
    in_blocks,
    is_cut,
    split,
    stated_test,
    with_joints,
)
from dln_jax.mechanics.friction import USUAL
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.types import InputError, JointVector, Needs

NO_GRAVITY = "no-gravity"
"""Check for torques from which a robot's controller has subtracted gravity."""
NOISY = "raw-differences"
"""Check for rates that are dominated by the noise of q."""
FILTERED = (
    "qd-sign", "qd-unlike", "qd-delay", "qd-exchanged", "qdd-unit", "qdd-sign", "qdd-unlike", "qdd-delay",
    "qdd-exchanged", NOISY, "quantisation", "jitter", "gaps", "rates", "repeated", "arrival",
)  # fmt: skip
"""Checks for faults that filtering q repairs."""
SPLIT = ("split", "repeated-motions")
"""Checks for faults that `split_log` resolves."""
ASSUMED = "assumed: neither the file nor --needs says"
"""Origin of assumed needs."""
USES = ("training", "validation", "the test")
"""Uses of the parts of a split, in their order."""
HELD_OUT = slice(2, None, 5)
"""Trajectories or blocks held out without validation: the third of every five."""


class Log(NamedTuple):
    """Trajectories with their context."""

    name: str
    """Name of the data in messages, usually the file."""
    data: Trajectories
    """The trajectories, filtered if `smoothed` is not `None`."""
    needs: Needs
    """Joints and terms of the plant."""
    needs_origin: str
    """Source of the needs."""
    remarks: tuple[str, ...] = ()
    """Lines on how the file was read, the source of the rates, and the findings of the check."""
    faults: tuple[str, ...] = ()
    """Faults in the log that no filter repairs."""
    robot: Robot | None = None
    """The robot that moved; without gravity if tau does not include it."""
    smoothed: Smoothed | None = None
    """The filter of q and its settings; `None` if the rates come from the file."""
    measured: Trajectories | None = None
    """The trajectories before the filter."""
    plant: LagrangianSystem | None = None
    """Energies of the true plant, if it is known."""
    tip: Any = None
    """q -> position [2] of the last body, m, for figures; `None` if unknown."""

    def __repr__(self) -> str:
        """Shows name, size and plant instead of the arrays."""
        size = f"{len(self.data.t)} samples of {len(np.unique(self.data.trajectory))} trajectories"
        return f"Log of {self.name}: {size}\n  {'-'.join(self.needs.joints)} ({self.needs_origin})"

    @property
    def torque(self) -> str:
        """Describes the torque, measured or filtered, to which models and uncertainty bands refer."""
        if self.smoothed is None or not self.smoothed.filtered_torque:
            return "measured torques"
        return f"torques low-passed at {self.smoothed.cutoff:.3g} Hz (measured ones scatter more)"

    @property
    def torque_noise(self) -> JointVector | None:
        """Standard deviation of the noise of filtered torques, N m or N; `None` if they are not filtered."""
        return None if self.smoothed is None or not self.smoothed.filtered_torque else self.smoothed.noise_tau


def read_log(
    path: str | Path,
    *,
    robot: Robot | str | Path | None = None,
    rate: float | None = None,
    units: Literal["si", "degrees"] | None = None,
    joints: Sequence[str] = (),
    topics: Sequence[str] = (),
    torque_factor: TorqueFactor | None = None,
    **known: Any,
) -> Log:
    """Reads, filters and checks a log: npz, CSV or a ROS bag.

    Args:
        path: the file, or the folder of a bag.
        robot: the robot that moved, or its URDF or MJCF file; joints are matched by name.
        rate: sampling rate of a file without t, Hz.
        units: units of CSV columns without a unit in the title, "si" or "degrees".
        joints: joints to keep, in this order; "LOG=NAME" renames one.
        topics: topics of joint states in a ROS bag (default: the only one).
        torque_factor: factor of tau, such as N m per A: one number, one per joint, or numbers by name.
        known: needs, needs_origin, assume, driven, cutoff (Hz), decimate, settled and accept_log, as for `log_of`.

    Returns:
        The trajectories in SI units, with the needs of the plant, faults that the check reported, and remarks.

    Raises:
        InputError: the file is missing, damaged or breaks the schema, its joints are not the robot's, the check reports
            an error and `accept_log` is false, or `log_of` refuses the data.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> import dln_jax
        >>> t = np.linspace(0.0, 10.0, 201)
        >>> rows = np.stack([t, np.sin(t), 9.81 * np.cos(np.sin(t)) - np.sin(t)], axis=1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savetxt(f"{folder}/log.csv", rows, delimiter=",", header="t [s],q [rad],tau [N m]", comments="")
        ...     log = dln_jax.read_log(f"{folder}/log.csv")
        >>> print(log.data.qdd.shape, log.needs.joints, log.faults)
        (201, 1) ('revolute',) ()
    """
    if robot is not None and not isinstance(robot, Robot):
        robot = read_robot(Path(robot))
    names = () if robot is None else robot.tree.names
    stated = {"rate": rate, "units": units, "torque_factor": torque_factor, "joints": joints, "topics": topics}
    data = schema.load(path, **stated, robot=names)
    return log_of(data, str(path), robot=robot, check=True, **known)


def log_of(
    data: Trajectories,
    name: str,
    *,
    robot: Robot | None = None,
    needs: Needs | None = None,
    needs_origin: str = "--needs",
    assume: Callable[[Trajectories], Needs] | None = None,
    driven: bool = True,
    cutoff: float | Literal["auto"] | None = None,
    decimate: int = 1,
    check: bool = False,
    settled: Collection[str] = SPLIT,
    accept_log: bool = False,
    more: str = "",
) -> Log:
    """Makes a log from trajectories in memory: completes the needs, filters q, derives rates and checks the data.

    Args:
        data: trajectories as read.
        name: name of the data in messages.
        robot: the robot that moved.
        needs: joints and terms of the plant (default: from the data, else from the robot with friction, else revolute
            joints with gravity and friction).
        needs_origin: source of `needs`, for messages.
        assume: trajectories -> assumed needs (default: revolute joints with gravity and friction).
        driven: whether torques drive the motions; free motions must have none, and keep their rates.
        cutoff: cut-off of the low-pass on q, Hz, from which rates follow; "auto" chooses it from the data, inf does not
            filter q (default: the rates of the data; "auto" if one is missing and q is noisy).
        decimate: with a cut-off, keep every n-th sample.
        check: run the checks for faults in users' data.
        settled: names of checks to ignore.
        accept_log: continue despite errors in the log.
        more: further options of `check_data`, for messages.

    Raises:
        InputError: needs, data and robot have different joints, torques are missing although `driven` or present
            although not, the data do not suit the cut-off, or the log has an error.
    """
    if robot is not None and robot.tree.names:
        try:
            data = with_joints(data, robot.tree.names)
        except InputError as error:
            raise InputError(str(error) if name in str(error) else f"{name}: {error}") from None
    if driven and "tau" in data.estimated:
        remarks = f" ({'; '.join(data.remarks)})" if data.remarks else ""
        raise InputError(
            f"{name}: column tau is missing, but torque models need it; add the measured torques, or fit motions "
            f"without applied forces with dln-jax train_hnn_task --task measured --data {name}{remarks}"
        )
    if not driven and np.any(data.tau):
        raise InputError(
            f"{name} has applied forces tau, but free motions have none; use dln-jax train_hnn --data {name}"
        )
    origin = needs_origin
    if needs is None and data.needs is not None:
        needs, origin = data.needs, "the data file"
    elif needs is None and robot is not None:
        needs, origin = robot.tree.needs._replace(joint_friction=USUAL), "the robot's file, and friction"
    elif needs is None:
        unknown = Needs(joints=("revolute",) * data.degrees_of_freedom, joint_friction=USUAL)
        needs, origin = unknown if assume is None else assume(data), ASSUMED
    if needs.degrees_of_freedom != data.degrees_of_freedom:
        raise InputError(
            f"{origin} has {needs.degrees_of_freedom} joints, but {name} has {data.degrees_of_freedom}; make them agree"
        )
    if robot is not None and needs.joints != robot.tree.joints:
        raise InputError(
            f"{origin} has joints {'-'.join(needs.joints)}, the robot {'-'.join(robot.tree.joints)}; make them agree"
        )
    data = data._replace(needs=needs)
    findings = quick(data, robot) if check else []
    noisy = [finding.observation for finding in findings if finding.check == NOISY]
    smoothed, measured = None, "qd" not in data.estimated
    if (cutoff is not None or (noisy and driven)) and not (measured and cutoff == np.inf and decimate == 1):
        try:
            smoothed = smooth(data, None if cutoff in (None, "auto") else cutoff, decimate=decimate)
        except InputError as error:
            if cutoff is not None:  # otherwise the log is too short for a filter and the finding remains
                raise InputError(f"--cutoff {cutoff}: {error}") from None
        else:
            if cutoff is None and measured and smoothed.left_out:
                smoothed = None  # recordings are worth more than smooth rates, and the finding remains
    ignored = {*settled, *(["friction"] if needs.friction or needs.joint_friction else [])}
    if smoothed is not None:
        # Splines without a filter keep the noise of q.
        ignored |= {check for check in FILTERED if check != NOISY or np.isfinite(smoothed.cutoff)}
    findings = [finding for finding in findings if finding.check not in ignored]
    remarks = list(preparation(data, smoothed) if driven else data.remarks)
    if cutoff is None and smoothed is not None:
        remarks.insert(0, f"q is filtered before differentiation: {noisy[0]} (--cutoff inf turns the filter off)")
    remarks += lines_on(findings, name, accept_log, f"dln-jax check_data --data {name}{more}")
    if robot is not None and any(finding.check == NO_GRAVITY for finding in findings):
        robot = robot._replace(tree=robot.tree._replace(gravity=np.zeros(3)))
    faults = [finding for finding in findings if finding.severity != "note" and finding.check != NO_GRAVITY]
    return Log(
        name=name,
        data=data if smoothed is None else smoothed.data,
        needs=needs,
        needs_origin=origin,
        remarks=tuple(remarks),
        faults=tuple(finding.observation for finding in faults),
        robot=robot,
        smoothed=smoothed,
        measured=data,
    )


def preparation(data: Trajectories, smoothed: Smoothed | None) -> list[str]:
    """Returns lines on how the file was read, and on the source and noise of rates and torques."""
    lines = list(data.remarks)
    if smoothed is None:
        if data.estimated:
            lines.append(f"not in the data: {', '.join(data.estimated)}; rates are raw finite differences")
        return lines
    kept = f"{smoothed.rate / smoothed.decimate:.4g} Hz in {smoothed.parts} parts, {len(smoothed.data.t)} samples"
    how = "given" if smoothed.choice is None else "chosen from the spectra of q"
    lines.append(
        f"rates: q is not filtered{', its noise is small' * (smoothed.choice is not None)}; splines, {kept}"
        if np.isinf(smoothed.cutoff)
        else f"rates: q filtered without delay at {smoothed.cutoff:.3g} Hz ({how}), {kept}"
    )
    torque = "filtered too" if smoothed.filtered_torque else "not filtered"
    sizes = [", ".join(f"{number:.2g}" for number in noise) for noise in (smoothed.noise_q, smoothed.noise_tau)]
    lines.append(f"noise of q {sizes[0]}; of tau {sizes[1]} ({torque})")
    if count := int((smoothed.repeats.q | smoothed.repeats.tau).sum()):
        lines.append(f"{count} samples repeat the previous one and are interpolated")
    if smoothed.clock is not None:
        lines.append(f"{smoothed.clock.line}; their times replace t")
    if smoothed.left_out:
        lines.append(f"{smoothed.left_out} segments are too short for the filter and are left out")
    return lines


def lines_on(findings: Sequence[Finding], name: str, accept_log: bool, check_data: str) -> list[str]:
    """Returns a line for each finding; `InputError` for an error, unless the log is accepted."""
    if not findings:
        return []
    errors = [f"{finding.observation}; {finding.remedy}" for finding in findings if finding.severity == "error"]
    if errors and not accept_log:
        raise InputError(f"{name}: {'; also '.join(errors)}; or continue with --accept-log (details: {check_data})")
    lines = [f"warning: {error}" for error in errors]
    lines += [finding.line for finding in findings if finding.severity != "error"]
    return [*lines, f"details: {check_data}"]


class Parts(NamedTuple):
    """The parts of a log."""

    sets: Split
    blocks: bool = False
    """Whether recordings were cut into blocks of time to have validation and test data."""
    remarks: tuple[str, ...] = ()


def split_log(log: Log, test: str | None = None, *, seed: int = 0, validation: bool = True) -> Parts:
    """Splits a log by trajectories; recordings of one motion stay together.

    Args:
        log: the log.
        test: comma-separated labels of the test trajectories; "last:30%" for the end of every trajectory; or "blocks"
            for ten blocks of time in each (default: every sixth trajectory, or without validation the third of every
            five; blocks if there are too few trajectories).
        seed: seed for drawing the validation trajectories.
        validation: hold out trajectories for model selection; otherwise that part is empty.

    Raises:
        InputError: as for `data.splits.stated_test` and `data.splits.split`; or the training or test set is empty.
    """
    data, labels = stated_test(log.data, test or None)
    recordings = len(np.unique(log.data.trajectory))
    if labels is None and not is_cut(test) and recordings < (LEAST_TRAJECTORIES if validation else 2):
        data = in_blocks(data, BLOCKS)
    elif labels and not is_cut(test) and log.smoothed is not None:
        labels = labels_of_parts(data, labels)
    present = np.unique(data.trajectory)
    blocks = len(present) != recordings
    motion = None if blocks else motion_numbers(data.q, data.trajectory)  # blocks of one motion may look alike
    share, chosen = (0.1, EVERY_SIXTH) if validation else (0.0, HELD_OUT)
    sets = split(data, test=labels, validation_share=share, seed=seed, motion=motion, chosen=chosen)
    remark = remark_on_repeats([sets.train, sets.validation], sets.test, motion)
    remarks = [remark] if remark else []
    if blocks and validation:
        counts = [f"{len(np.unique(part.trajectory))} for {use}" for part, use in zip(sets, USES, strict=True)]
        which = "one recording" if recordings == 1 else f"{recordings} recordings"
        remarks.append(f"{which}: cut into blocks of time, {', '.join(counts)}")
    return Parts(sets, blocks, tuple(remarks))
