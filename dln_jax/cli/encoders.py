"""Options of commands that read logs, and the lines printed about a log before training."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dln_jax.cli.arguments import Unstated, refuse_given
from dln_jax.data.checks import quick
from dln_jax.data.encoders import Smoothed, smooth
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.types import InputError

AUTO = "auto"
FILTERED = (
    "qd-sign", "qd-unlike", "qd-delay", "qd-exchanged", "qdd-unit", "qdd-sign", "qdd-unlike", "qdd-delay",
    "qdd-exchanged", "raw-differences", "quantisation", "jitter", "gaps", "rates", "repeated",
)  # fmt: skip
"""Checks for faults that filtering q replaces or repairs."""


@dataclass(frozen=True)
class Logged:
    """Facts that a log does not state."""

    rate: Unstated[float] = None
    """Hz, at which a file without t was sampled."""
    units: Unstated[Literal["si", "degrees"]] = None
    """CSV: units of titles that state none; degrees: of angles, and SI for the rest."""


@dataclass(frozen=True)
class Checked(Logged):
    """How to treat a log with errors."""

    accept_log: bool = False
    """Go on although the check of the log found errors, which then are warnings."""


@dataclass(frozen=True)
class Filtered(Checked):
    """How to derive rates where a log has no reliable ones."""

    cutoff: Unstated[str] = None
    """Low-pass q without delay at so many Hz, and derive the rates from it; auto: a cut-off chosen from the data
    (default: the rates of the file, by finite differences where it has none)."""
    decimate: Unstated[int] = None
    """With --cutoff: keep every so manyth sample, of filtered torques too (default: 1, and torques as they are)."""


def smoothed(given: Filtered, data: Trajectories) -> Smoothed | None:
    """Filters a log as the options ask; `None` without --cutoff.

    Raises:
        InputError: an invalid cut-off, --decimate without --cutoff, or data that `data.encoders.smooth` refuses.
    """
    if given.cutoff is None:
        refuse_given(given, ["decimate"], "for filtered data: add --cutoff auto")
        return None
    cutoff = None if given.cutoff == AUTO else _hertz(given.cutoff)
    decimate = 1 if given.decimate is None else given.decimate
    try:
        return smooth(data, cutoff, decimate=decimate)
    except InputError as error:
        raise InputError(f"--cutoff {given.cutoff}: {error}") from None


def preparation(data: Trajectories, found: Smoothed | None) -> list[str]:
    """Lines that state where rates and torques come from, and how noisy they are."""
    if found is None:
        estimated = [key for key in data.estimated if key != "tau"]
        lines = [f"not in the data: {', '.join(data.estimated)}"] if data.estimated else []
        if estimated:
            lines[0] += "; rates are raw finite differences, which amplify noise: --cutoff auto filters q first"
        return lines
    kept = f"{found.rate / found.decimate:.4g} Hz in {found.parts} parts"
    how = "given" if found.choice is None else "chosen from the spectra of q"
    lines = [
        f"rates: q is not filtered, as its noise is too small; derivatives of splines, {kept}"
        if np.isinf(found.cutoff)
        else f"rates: q filtered without delay at {found.cutoff:.3g} Hz ({how}), {kept}"
    ]
    torque = "filtered alike" if found.filtered_torque else "not filtered"
    sizes = [", ".join(f"{each:.2g}" for each in noise) for noise in (found.noise_q, found.noise_tau)]
    lines.append(f"noise of q {sizes[0]}; of tau {sizes[1]} ({torque})")
    if count := int((found.repeats.q | found.repeats.tau).sum()):
        lines.append(f"{count} samples repeat the one before and are resampled over")
    if found.left_out:
        lines.append(f"{found.left_out} segments are too short for the filter and left out")
    return lines


def fitted_torque(found: Smoothed | None) -> str:
    """Names the torque, measured or filtered, that a model is fitted to and its uncertainty bands refer to."""
    if found is None or not found.filtered_torque:
        return "measured torques"
    return f"torques low-passed at {found.cutoff:.3g} Hz (measured ones scatter more)"


def checked(
    given: Checked,
    data: Trajectories,
    path: Path,
    *,
    robot: Robot | None = None,
    without: Collection[str] = (),
) -> list[str]:
    """Findings of the quick checks of `check_data`, one line per finding.

    Args:
        given: options; with a cut-off, checks that concern only the file's own rates (`FILTERED`) are skipped.
        data: unfiltered data of the file.
        path: the file.
        robot: robot that the log is compared with, if any.
        without: names of checks that do not matter for this command.

    Raises:
        InputError: the log has an error, and --accept-log is not set.
    """
    filtered = isinstance(given, Filtered) and given.cutoff is not None
    settled = {*without, *(FILTERED if filtered else ())}
    found = [finding for finding in quick(data, robot) if finding.check not in settled]
    if not found:
        return []
    more = f"python -m scripts.check_data --data {path}"
    if getattr(given, "robot", None) is not None:
        more += f" --robot {getattr(given, 'robot')}"  # noqa: B009  only some commands have it
        more += f" --lock '{lock}'" if (lock := getattr(given, "lock", None)) else ""
    errors = [f"{finding.observation}; {finding.remedy}" for finding in found if finding.severity == "error"]
    if errors and not given.accept_log:
        raise InputError(f"{path}: {'; also '.join(errors)}; or go on with --accept-log ({more} says more)")
    lines = [f"warning: {finding.observation}; {finding.remedy}" for finding in found if finding.severity == "error"]
    return [*lines, *(finding.line for finding in found if finding.severity != "error"), f"{more} says more"]


def _hertz(text: str) -> float:
    try:
        value: Any = float(text)
    except ValueError:
        value = -1.0
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"--cutoff is {text!r:.40}; expected Hz, a positive number, or auto")
    return value
