"""Run one command over a grid of its options, each combination as a job of its own, here, by Slurm or by Ray.

The grid is for example 'width=8,16 seed=0:10 data=a.npz,b.npz': values by commas, a:b and a:b:step for whole numbers
without b, and all combinations of them. Options are checked before anything starts. A sweep's folder gets a folder for
each job, table.csv with all their metrics, sweep.json and sweep.png: error against seconds, and the best by validation
alone. Jobs that fail are listed with their one line, and the exit status is 1; --resume does only what is not done.
slurm needs the extra [sweep], ray the extra [ray]; hosts must share the sweep's folder.
"""

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from dln_jax.cli.arguments import Unstated, require_positive_if_given
from dln_jax.cli.commands import COMMANDS
from dln_jax.cli.options import Resumable
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.cli.sweeps.grid import fixed_of, grid_of, pairs
from dln_jax.cli.sweeps.plan import closest, plan
from dln_jax.cli.sweeps.sweep import Asked, sweep
from dln_jax.types import InputError


@dataclass(frozen=True)
class Arguments(Resumable):
    """What to run, where to run it, and how to compare the jobs."""

    CHANGEABLE: ClassVar = ("where", "jobs", "gpus", "slurm", "metric", "best", "error", "over")

    command: str = "train_delan"
    """The command of every job."""
    grid: Unstated[str] = None
    """Options and their values: 'width=8,16 seed=0:10'."""
    fixed: str = ""
    """Options that all jobs have: 'steps=500 figures=no test=e,q,v'; a comma is part of the value."""
    where: Unstated[Literal["here", "slurm", "ray", "later"]] = None
    """What runs the jobs: processes on this machine, an array of the Slurm cluster, Ray, or what you have: later only
    writes the jobs' lines (default: here)."""
    jobs: Unstated[int] = None
    """Jobs at once (default: as many as there are cores; of Slurm, what it allows). Times are those beside others."""
    gpus: Unstated[int] = None
    """here and ray: accelerators of this machine; each job has one to itself (default: 0, jobs see none)."""
    slurm: Unstated[str] = None
    """Options of sbatch: 'partition=gpu time=60 gpus_per_node=1', time in minutes (default: 60); a job whose time is up
    is queued again and continues."""
    metric: Unstated[str] = None
    """Metric to select by, of metrics.json (default: the command's validation error)."""
    best: Unstated[Literal["smallest", "largest"]] = None
    """Which --metric is the best (default: smallest)."""
    error: Unstated[str] = None
    """Metric that is shown beside it, and not selected by (default: the command's test error)."""
    over: Unstated[str] = None
    """Options, separated by commas, over which medians and the worst are taken (default: seed)."""


def main(given: Arguments) -> None:
    """Checks the grid, runs the jobs and shows the results; raises `SystemExit` with 1 if a job is not done."""
    require_positive_if_given(given, ("jobs", "gpus"))
    grid, fixed = grid_of(given.grid or ""), fixed_of(given.fixed)
    if given.jobs is not None and given.jobs > (given.gpus or given.jobs):
        raise InputError(f"--jobs {given.jobs} for --gpus {given.gpus}; each job has one: give fewer jobs")
    asked = Asked(
        where=given.where or "here",
        at_once=given.jobs,
        gpus=given.gpus or 0,
        slurm=given.slurm or "",
        metric=given.metric,
        largest=given.best == "largest",
        error=given.error,
        over=over_of(given.over, grid),
    )
    if given.slurm is not None and asked.where not in ("slurm", "later"):
        raise InputError(f"--slurm is for --where slurm; leave it out of --where {asked.where}")
    if given.slurm is not None:
        pairs("--slurm", given.slurm)
    name = given.command.replace("-", "_")
    arguments = arguments_of(name)
    plan(name, arguments, grid, fixed, Path())  # refused before there is a folder
    with command_folder(given, "sweep") as folder:
        jobs = plan(name, arguments, grid, fixed, folder.absolute())
        if not sweep(jobs, asked, folder.absolute()):
            raise SystemExit(1)


def arguments_of(command: str) -> type:
    """The dataclass of a command's arguments; `InputError` for an unknown command or `sweep` itself."""
    known = [name for name in COMMANDS if name != "sweep"]
    if command not in known:
        like = closest(command, known)
        raise InputError(f"--command: there is no {command!r:.40}{like} (see python -m dln_jax --help)")
    return importlib.import_module(f"dln_jax.cli.commands.{command}").Arguments


def over_of(text: str | None, grid: dict[str, tuple[str, ...]]) -> tuple[str, ...]:
    """Options named by --over, by default seed if the grid has it; `InputError` for one that is not in the grid."""
    if text is None:
        return ("seed",) if "seed" in grid else ()
    names = tuple(name.strip().replace("-", "_") for name in text.split(","))
    if unknown := [name for name in names if name not in grid]:
        raise InputError(f"--over: {unknown[0]!r:.40} is not in --grid; choose from {', '.join(grid)}")
    return names
