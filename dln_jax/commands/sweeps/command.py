"""Runs a sweep: checks, jobs, table and figure."""

import importlib
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dln_jax.commands.sweeps.executors import cores, here, ray, run, slurm
from dln_jax.commands.sweeps.grid import closest, grid_of, jobs_of, pairs
from dln_jax.commands.sweeps.job import Job, status_of
from dln_jax.commands.sweeps.table import compared, drawn, print_results, write_tables
from dln_jax.files import write_figure
from dln_jax.runs.arguments import require_positive_if_given
from dln_jax.runs.progress import progress
from dln_jax.runs.stored_arguments import command_folder
from dln_jax.types import InputError

LATER = "jobs.sh"
"""File in the sweep's folder with the command lines of the jobs, for --where later."""
MOST_IN_ARRAY = 1000
"""Largest number of jobs in an array, Slurm's default MaxArraySize."""


def sweep(options: Any, commands: Sequence[str]) -> None:
    """Checks the grid, runs the jobs and shows the results; raises `SystemExit` with 1 if a job is not done."""
    require_positive_if_given(options, ("jobs", "gpus"))
    grid, fixed, over = grid_of(options.grid or ""), pairs("--fixed", options.fixed), options.over
    if options.jobs is not None and options.jobs > (options.gpus or options.jobs):
        raise InputError(f"--jobs {options.jobs} for --gpus {options.gpus}; each job has one: give fewer jobs")
    names = [name.strip().replace("-", "_") for name in over.split(",")] if over else ["seed"] * ("seed" in grid)
    if unknown := [name for name in names if name not in grid]:
        raise InputError(f"--over: {unknown[0]!r:.40} is not in --grid; choose from {', '.join(grid)}")
    if options.slurm is not None and options.where not in ("slurm", "later"):
        raise InputError(f"--slurm is for --where slurm; leave it out of --where {options.where or 'here'}")
    pairs("--slurm", options.slurm or "")
    command = options.command.replace("-", "_")
    arguments = arguments_of(command, commands)
    jobs = jobs_of(command, arguments, grid, fixed, Path())  # mistakes are refused before there is a folder
    with command_folder(options, "sweep") as out:
        folder = out.absolute()
        jobs = [job._replace(folder=folder / job.folder) for job in jobs]
        left = [job for job in jobs if status_of(job.folder).state != "done"]
        if options.where == "later":
            (folder / LATER).write_text("".join(f"{shlex.join(job.line(job.folder / 'run'))}\n" for job in left))
            print(f"{len(left)} jobs, a line each in {folder / LATER}, to be run from {Path.cwd()}")
            print(f"the table is made by: --out {folder} --resume --where here")
            return
        if left:
            execute(left, len(jobs), options, folder)
        results = compared(jobs, names, metric=options.metric, error=options.error, largest=options.best == "largest")
        facts = {"command": command, "where": options.where or "here", "at_once": at_once(options)}
        write_tables(folder, results, **facts)
        if figure := drawn(results, at_once=at_once(options)):
            write_figure(folder / "sweep.png", figure)
        print_results(results, command, folder)
        if any(entry.status.state != "done" for entry in results.entries):
            raise SystemExit(1)


def arguments_of(command: str, commands: Sequence[str]) -> type:
    """The dataclass of a command's arguments; `InputError` for an unknown command or `sweep` itself."""
    known = [name for name in commands if name != "sweep"]
    if command not in known:
        like = closest(command, known)
        raise InputError(f"--command: there is no {command!r:.40}{like} (see python -m dln_jax --help)")
    return importlib.import_module(f"dln_jax.commands.{command}").Arguments


def execute(left: Sequence[Job], jobs: int, options: Any, folder: Path) -> None:
    """Runs the jobs that are left of `jobs`, with progress.

    Raises:
        InputError: the executor is missing or refuses the jobs.
        KeyboardInterrupt: running jobs have been interrupted and can be resumed.
    """
    where, beside = options.where or "here", at_once(options)
    if where == "slurm":
        if len(left) > MOST_IN_ARRAY:
            raise InputError(f"{len(left)} jobs for one Slurm array; expected at most {MOST_IN_ARRAY}; split the grid")
        executor = slurm(folder, beside, options.slurm or "")
    else:
        executor = (ray if where == "ray" else here)(beside or 1, options.gpus or 0)
    done = f", {jobs - len(left)} are done" if len(left) < jobs else ""
    share = "an array of the cluster" if beside is None else f"{beside} at once"
    with executor as (submit, together), progress(len(left), "jobs") as show:
        print(f"{left[0].command}: {len(left)} of {jobs} jobs{done}; {where}, {share}", flush=True)
        run(left, submit, together, lambda ended, bad: show(ended, f"{bad} not done" if bad else ""))


def at_once(options: Any) -> int | None:
    """Number of jobs at once; `None` if Slurm decides."""
    return options.jobs or (None if options.where == "slurm" else options.gpus or cores())
