"""Run a command for every combination of options.

Jobs run on this machine, or with Slurm or Ray. An example of a grid is 'width=8,16 seed=0:10 data=a.npz,b.npz': commas
separate values, and a:b and a:b:step are whole numbers below b. Options are checked before anything starts. The folder
of the sweep gets a folder for each job, table.csv with all metrics, sweep.json and sweep.png, which shows error against
seconds and marks the best job by validation. Failed jobs are listed with their error message, and the exit status is 1;
--resume runs only the unfinished jobs. Slurm needs the extra [sweep], Ray the extra [ray], and all hosts must share the
sweep's folder.
"""

import importlib
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from dln_jax.commands import COMMANDS
from dln_jax.errors import InputError
from dln_jax.options import Resumable, Unstated
from dln_jax.runs.arguments import closest, names_in, require_positive_if_given


@dataclass(frozen=True)
class Arguments(Resumable):
    """What to run, where to run it, and how to compare the jobs."""

    CHANGEABLE: ClassVar = ("where", "jobs", "gpus", "slurm", "metric", "best", "error", "over")

    command: str = "train_delan"
    """The command of every job."""
    grid: Unstated[str] = None
    """Options and their values: 'width=8,16 seed=0:10'."""
    fixed: str = ""
    """Options that all jobs share: 'steps=500 figures=no test=e,q,v'; commas belong to the value."""
    where: Unstated[Literal["here", "slurm", "ray", "later"]] = None
    """Where jobs run: as processes on this machine, as an array of the Slurm cluster, or with Ray. later only writes
    the command lines, for another scheduler (default: here)."""
    jobs: Unstated[int] = None
    """Number of jobs at once (default: one for each core; with Slurm, as many as it allows). Jobs that run at the same
    time slow each other down."""
    gpus: Unstated[int] = None
    """here and ray: number of GPUs of this machine; each job has one to itself (default: 0)."""
    slurm: Unstated[str] = None
    """Options of sbatch: 'partition=gpu time=60 gpus_per_node=1', time in minutes (default: 60). A job that reaches its
    time limit is queued again and continues."""
    metric: Unstated[str] = None
    """Metric of metrics.json that chooses the best job (default: the command's validation error)."""
    best: Unstated[Literal["smallest", "largest"]] = None
    """Whether the smallest or the largest --metric is best (default: smallest)."""
    error: Unstated[str] = None
    """Metric shown beside --metric, without influence on the choice (default: the command's test error)."""
    over: Unstated[str] = None
    """Comma-separated options over which medians and worst values are taken (default: seed)."""


def main(options: Arguments) -> None:
    """Checks the grid, runs the jobs and shows the results; raises `SystemExit` with 1 if a job is not done."""
    from dln_jax.commands.sweeps.executors import cores, here, ray, run, slurm
    from dln_jax.commands.sweeps.jobs import grid_of, jobs_of, pairs, status_of
    from dln_jax.commands.sweeps.results import compare, print_results, sweep_figure, write_tables
    from dln_jax.files import write_figure
    from dln_jax.runs.folder import command_folder
    from dln_jax.runs.progress import progress

    require_positive_if_given(options, ("jobs", "gpus"))
    grid, fixed, where = grid_of(options.grid or ""), pairs("--fixed", options.fixed), options.where or "here"
    if options.jobs is not None and options.jobs > (options.gpus or options.jobs):
        raise InputError(
            f"--jobs {options.jobs} for --gpus {options.gpus}; each job needs its own GPU; give fewer jobs"
        )
    over = ["seed"] if "seed" in grid else []
    if options.over is not None:
        over = names_in("--over", options.over.replace("-", "_"), grid)
    if options.slurm is not None and where not in ("slurm", "later"):
        raise InputError(f"--slurm is for --where slurm; leave it out of --where {where}")
    pairs("--slurm", options.slurm or "")
    command, known = options.command.replace("-", "_"), [name for name in COMMANDS if name != "sweep"]
    if command not in known:
        raise InputError(f"--command: there is no {command!r:.40}{closest(command, known)} (see dln-jax --help)")
    arguments = importlib.import_module(f"dln_jax.commands.{command}").Arguments
    jobs_of(command, arguments, grid, fixed, Path())  # mistakes are refused before there is a folder
    at_once = options.jobs or (None if where == "slurm" else options.gpus or cores())
    with command_folder(options, "sweep") as out:
        folder = out.absolute()
        jobs = jobs_of(command, arguments, grid, fixed, folder)
        left = [job for job in jobs if status_of(job.folder).state != "done"]
        if where == "later":
            lines = folder / "jobs.sh"
            lines.write_text("".join(f"{shlex.join(job.line(job.folder / 'run'))}\n" for job in left))
            print(f"{lines} has the command lines of {len(left)} jobs; run them from {Path.cwd()}")
            print(f"make the table with --out {folder} --resume --where here")
            return
        if left:
            if where == "slurm":
                executor = slurm(folder, at_once, options.slurm or "", len(left))
            else:
                executor = (ray if where == "ray" else here)(at_once or 1, options.gpus or 0)
            done = f", {len(jobs) - len(left)} are done" if len(left) < len(jobs) else ""
            share = "an array of the cluster" if at_once is None else f"{at_once} at once"
            with executor as submit, progress(len(left), "jobs") as show:
                print(f"{command}: {len(left)} of {len(jobs)} jobs{done}; {where}, {share}", flush=True)
                run(left, submit, lambda ended, bad: show(ended, f"{bad} not done" if bad else ""))
        results = compare(jobs, over, metric=options.metric, error=options.error, largest=options.best == "largest")
        write_tables(folder, {"command": command, "where": where, "at_once": at_once, **results})
        if figure := sweep_figure(results, at_once):
            write_figure(folder / "sweep.png", figure)
        print_results(results, command, folder)
        if any(row["state"] != "done" for row in results["jobs"]):
            raise SystemExit(1)
