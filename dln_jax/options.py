"""Annotations for options, and options that several commands share. Does not import JAX."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro

T = TypeVar("T")

Unstated = Annotated[T | None, tyro.conf.arg(help_behavior_hint="")]
"""An option that is `None` by default; its help text states the effective default."""
InPython = Annotated[T, tyro.conf.Fixed, tyro.conf.Suppress]
"""A keyword for Python only, hidden from the command line."""


def choice(names: Iterable[str], *, several: bool = False, unstated: bool = False) -> Any:
    """Shows the allowed names of an option in its help, for `Annotated[str, ...]`.

    With `several` the option takes a list of names, by default all; `unstated` hides the default, as for `Unstated`.
    """
    return tyro.conf.arg(
        metavar="{" + ",".join(names) + "}" + "[,...]" * several, help_behavior_hint="" if several or unstated else None
    )


SCENES = (
    *("two-link-arm", "two-link-arm-hanging", "pendulum", "double-pendulum", "cart-pole", "flexible-cart-pole"),
    *("rotary-pendulum", "acrobot", "pendubot", "mass-spring", "henon-heiles", "two-body", "three-body"),
    *("chain-1", "chain-2", "chain-3", "chain-4", "chain-5", "chain-6"),
    *("chain-7", "chain-8", "chain-9", "chain-10", "chain-11", "chain-12"),
)
"""Names of `scenes.registry`, which imports JAX."""
SceneName = Annotated[str, choice(SCENES)]


@dataclass(frozen=True)
class Folder:
    """Where the results go."""

    out: Unstated[Path] = None
    """Folder of the results (default: runs/NAME-1, -2, ...)."""


@dataclass(frozen=True)
class Resumable(Folder):
    """Where the results go, and whether to resume a run there."""

    resume: bool = False
    """Continue the run in --out with its settings."""


@dataclass(frozen=True)
class Drawn:
    """Whether to draw figures."""

    figures: bool = True
    """Draw the figures."""


@dataclass(frozen=True)
class Limited:
    """Time limit until the model is stored."""

    seconds: Unstated[float] = None
    """Time limit for training, s (default: none)."""


@dataclass(frozen=True)
class Devices:
    """Devices of one process that share the work."""

    devices: Unstated[int] = None
    """Devices per process (default: 1; several processes: all)."""


@dataclass(frozen=True)
class Scaled(Devices):
    """Devices and processes that share the work."""

    processes: Unstated[int] = None
    """Processes of this run (default: tasks of srun or mpirun, else 1)."""
    coordinator: Unstated[str] = None
    """host:port of process 0."""
    process_id: Unstated[int] = None
    """Number of this process, from 0."""


@dataclass(frozen=True)
class Logged:
    """Facts that a log does not state."""

    rate: Unstated[float] = None
    """Sampling rate of a file without t, Hz."""
    units: Unstated[Literal["si", "degrees"]] = None
    """Units of CSV columns without a unit in the title."""
    joints: Unstated[str] = None
    """Joints to keep, in this order; LOG=NAME renames one (default: all; names may have a prefix or ending)."""
    topics: Unstated[str] = None
    """ROS bag: topics of joint states, comma separated (default: the only one)."""
    torque_factor: Unstated[str] = None
    """Factor of tau, such as N m per A where currents were logged: one number, one per joint, or NAME=NUMBER."""


@dataclass(frozen=True)
class Checked(Logged):
    """How to treat a log with errors."""

    accept_log: bool = False
    """Continue in spite of errors in the log."""


@dataclass(frozen=True)
class Filtered(Checked):
    """How to derive rates where a log has no reliable ones."""

    cutoff: Unstated[str] = None
    """Cut-off of the low-pass filter on q that gives rates, Hz; auto, or inf for none (default: the file's rates; auto
    if it has no qdd and differences are noisy)."""


@dataclass(frozen=True)
class CompilationCache:
    """The option of all commands."""

    compilation_cache: bool = True
    """Keep compiled programs in your cache folder (at most 512 MiB)."""


@dataclass(frozen=True)
class NoCompilationCache(CompilationCache):
    """The option of commands that measure compilation."""

    compilation_cache: bool = False
    """Keep compiled programs for the next command; off where compilation is measured."""
