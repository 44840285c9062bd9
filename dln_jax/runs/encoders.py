"""Options of commands that read logs, and the lines printed about a log before training."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.data.checks.channels import Finding
from dln_jax.data.checks.report import quick
from dln_jax.data.encoders.smoothing import Smoothed, smooth
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.stated_needs import needs_from_text
from dln_jax.runs.arguments import names_listed, numbers_of, refuse_given
from dln_jax.runs.options import Checked, Filtered, Logged
from dln_jax.types import InputError, Needs, require_once

AUTO = "auto"
NO_GRAVITY = "no-gravity"
"""Check for torques from which a robot's controller has subtracted gravity."""
NOISY = "raw-differences"
"""Check for rates whose differences are dominated by the noise of q."""
FILTERED = (
    "qd-sign", "qd-unlike", "qd-delay", "qd-exchanged", "qdd-unit", "qdd-sign", "qdd-unlike", "qdd-delay",
    "qdd-exchanged", NOISY, "quantisation", "jitter", "gaps", "rates", "repeated", "arrival",
)  # fmt: skip
"""Checks for faults that filtering q replaces or repairs."""


def facts(options: Logged) -> dict[str, Any]:
    """Keywords of `data.schema.load` that the options state."""
    factor = None if options.torque_factor is None else _factor(options.torque_factor)
    names = {"joints": names_listed(options.joints), "topics": names_listed(options.topics)}
    return {"rate": options.rate, "units": options.units, "torque_factor": factor, **names}


def without_torque(data: Trajectories) -> str:
    """Remarks on how a file without torques was read, for the end of a message; empty if there are none."""
    return f" ({'; '.join(data.remarks)})" if data.remarks else ""


def _factor(text: str) -> float | tuple[float, ...] | dict[str, float]:
    option = "--torque-factor"
    if "=" in text:
        pairs = [entry.partition("=") for entry in text.split(",")]
        names = [name.strip() for name, _, _ in pairs]
        require_once(option, names)
        return {name: numbers_of(f"{option} {name}", pair[2], [1])[0] for name, pair in zip(names, pairs, strict=True)}
    numbers = numbers_of(option, text)
    return numbers[0] if len(numbers) == 1 else numbers


def prepare_log(
    options: Filtered,
    data: Trajectories,
    path: Path | None,
    *,
    robot: Robot | None = None,
    without: Collection[str] = (),
) -> tuple[Smoothed | None, list[str], tuple[str, ...], Robot | None]:
    """Checks a log and filters it: as --cutoff states, else if its rates are missing and the noise of q matters.

    Returns the filtered log or `None`, lines for the user, the faults that no filter repairs, and the robot, without
    gravity if tau holds none.

    Args:
        options: options of the command.
        data: unfiltered data.
        path: file of the data; `None` for data that need no check.
        robot: robot that the log is compared with, if any.
        without: names of checks that do not matter for this command.

    Raises:
        InputError: an invalid cut-off, --decimate without --cutoff, data that `data.encoders.smooth` refuses, or the
            log has an error, and --accept-log is not set.
    """
    findings = [] if path is None else quick(data, robot)
    noisy = [finding.observation for finding in findings if finding.check == NOISY and "qd" in data.estimated]
    filtered, lines, cutoff = None, [], options.cutoff
    if cutoff is None:
        refuse_given(options, ["decimate"], "for filtered data: add --cutoff auto")
    if cutoff is not None or noisy:
        hertz = None if cutoff in (None, AUTO) else _hertz(cutoff)
        decimate = 1 if options.decimate is None else options.decimate
        try:
            filtered = smooth(data, hertz, decimate=decimate)
        except InputError as error:
            if cutoff is not None:  # otherwise the finding remains: the log is too short for a filter
                raise InputError(f"--cutoff {cutoff}: {error}") from None
    if cutoff is None and filtered is not None:
        lines = [f"q is filtered before it is differentiated: {noisy[0]} (--cutoff inf leaves q as it is)"]
    settled = set(without) if filtered is None else {*without, *FILTERED}
    if filtered is not None and np.isinf(filtered.cutoff):  # splines through q keep its noise
        settled.discard(NOISY)
    findings = [finding for finding in findings if finding.check not in settled]
    lines = [*lines, *preparation(data, filtered), *_lines(options, path, findings)]
    if robot is not None and any(finding.check == NO_GRAVITY for finding in findings):
        robot = robot._replace(tree=robot.tree._replace(gravity=np.zeros(3)))
    faults = [finding for finding in findings if finding.severity != "note" and finding.check != NO_GRAVITY]
    return filtered, lines, tuple(finding.observation for finding in faults), robot


def preparation(data: Trajectories, filtered: Smoothed | None) -> list[str]:
    """Lines that state how the file was read, where rates and torques come from, and how noisy they are."""
    lines = list(data.remarks)
    if filtered is None:
        if data.estimated:
            lines.append(f"not in the data: {', '.join(data.estimated)}; rates are raw finite differences")
        return lines
    kept = f"{filtered.rate / filtered.decimate:.4g} Hz in {filtered.parts} parts"
    how = "given" if filtered.choice is None else "chosen from the spectra of q"
    lines.append(
        f"rates: q is not filtered{', as its noise is too small' * (filtered.choice is not None)}; splines, {kept}"
        if np.isinf(filtered.cutoff)
        else f"rates: q filtered without delay at {filtered.cutoff:.3g} Hz ({how}), {kept}"
    )
    torque = "filtered alike" if filtered.filtered_torque else "not filtered"
    sizes = [", ".join(f"{number:.2g}" for number in noise) for noise in (filtered.noise_q, filtered.noise_tau)]
    lines.append(f"noise of q {sizes[0]}; of tau {sizes[1]} ({torque})")
    if count := int((filtered.repeats.q | filtered.repeats.tau).sum()):
        lines.append(f"{count} samples repeat the one before and are resampled over")
    if filtered.clock is not None:
        lines.append(f"{filtered.clock.line}; their times replace t")
    if filtered.left_out:
        lines.append(f"{filtered.left_out} segments are too short for the filter and left out")
    return lines


def fitted_torque(filtered: Smoothed | None) -> str:
    """Names the torque, measured or filtered, that a model is fitted to and its uncertainty bands refer to."""
    if filtered is None or not filtered.filtered_torque:
        return "measured torques"
    return f"torques low-passed at {filtered.cutoff:.3g} Hz (measured ones scatter more)"


def checked(options: Checked, data: Trajectories, path: Path, *, without: Collection[str] = ()) -> list[str]:
    """Findings of the quick checks of `check_data`, one line per finding.

    Args:
        options: options of the command.
        data: data of the file.
        path: file of the data.
        without: names of checks that do not matter for this command.

    Raises:
        InputError: the log has an error, and --accept-log is not set.
    """
    return _lines(options, path, [finding for finding in quick(data) if finding.check not in without])


def _lines(options: Checked, path: Path | None, findings: Sequence[Finding]) -> list[str]:
    if not findings:
        return []
    more = f"python -m scripts.check_data --data {path}"
    if getattr(options, "robot", None) is not None:
        more += f" --robot {getattr(options, 'robot')}"  # noqa: B009  only some commands have it
        more += f" --lock '{lock}'" if (lock := getattr(options, "lock", None)) else ""
    errors = [f"{finding.observation}; {finding.remedy}" for finding in findings if finding.severity == "error"]
    if errors and not options.accept_log:
        raise InputError(f"{path}: {'; also '.join(errors)}; or go on with --accept-log ({more} says more)")
    lines = [f"warning: {finding.observation}; {finding.remedy}" for finding in findings if finding.severity == "error"]
    lines += [finding.line for finding in findings if finding.severity != "error"]
    return [*lines, f"{more} says more"]


def _hertz(text: str) -> float:
    try:
        value: Any = float(text)
    except ValueError:
        value = -1.0
    if not value > 0:
        raise InputError(f"--cutoff is {text!r:.40}; expected Hz, a positive number, or auto (inf: no filter)")
    return value


def needs_from_option(text: str) -> Needs:
    """Parses --needs; `InputError` if the text does not state valid needs."""
    try:
        return needs_from_text(text)
    except InputError as error:
        raise InputError(f"--{error}; see --help for an example") from None
