"""Options shared by several commands. A command inherits the ones it takes; its help shows its own options first."""

from dataclasses import dataclass
from pathlib import Path

from dln_jax.cli.arguments import Unstated


@dataclass(frozen=True)
class Folder:
    """Where the results go."""

    out: Unstated[Path] = None
    """Folder of the results (default: runs/NAME-1, -2, ..., for a command NAME)."""


@dataclass(frozen=True)
class Resumable(Folder):
    """Where the results go, and whether to resume a run there."""

    resume: bool = False
    """Continue what is in --out with the settings it was started with."""


@dataclass(frozen=True)
class Drawn:
    """Whether to draw figures."""

    figures: bool = True
    """Draw the figures."""


@dataclass(frozen=True)
class Limited:
    """Time limit until the model is stored."""

    seconds: Unstated[float] = None
    """Seconds from the start of the command until the model is stored (default: no limit). Reading the data, choosing a
    model, compiling and fitting count; the evaluation, timings and figures that follow do not. The best parameters so
    far are kept. Every fit does at least one dispatch of iterations, which may pass the limit. With --resume the
    seconds count anew, and another number may be given."""


@dataclass(frozen=True)
class SingleCalls:
    """How to time single calls of a model."""

    low_latency: bool = True
    """Time single calls also in low-latency mode, in a process of its own (about 2 s)."""


@dataclass(frozen=True)
class Scaled:
    """Devices and processes that share the work."""

    devices: Unstated[int] = None
    """Devices of every process that share the batches (default: 1 of one process, of several all that each sees). A
    processor makes any number, whose work then goes side by side."""
    processes: Unstated[int] = None
    """Processes, on one host or several, that are one run: start the same command in each, with --coordinator and
    --process-id (default: the tasks of srun or mpirun, else 1)."""
    coordinator: Unstated[str] = None
    """host:port of process 0, with a free port, which all processes can reach."""
    process_id: Unstated[int] = None
    """Which of --processes this one is, from 0; 0 prints and writes the results."""
