"""A sweep from its jobs to its table: what is not done is run, and everything is shown."""

import collections
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Literal, NamedTuple

from dln_jax.command_line.progress import progress
from dln_jax.files import write_figure
from dln_jax.sweeps.drawing import drawn, undone
from dln_jax.sweeps.engines import Engine, run_all
from dln_jax.sweeps.here import cores, here
from dln_jax.sweeps.on_ray import ray
from dln_jax.sweeps.plan import Job, write_jobs
from dln_jax.sweeps.results import Entry, Names, best_of, entries, groups, names_in
from dln_jax.sweeps.slurm import slurm
from dln_jax.sweeps.status import status_of
from dln_jax.sweeps.tables import print_groups, print_jobs, said, write_tables


class Asked(NamedTuple):
    """How to run a sweep, and how to compare; None is the default that the command's help states."""

    where: Literal["here", "slurm", "ray"] = "here"
    at_once: int | None = None
    gpus: int = 0
    slurm: str = ""
    metric: str | None = None
    largest: bool = False
    error: str | None = None
    over: tuple[str, ...] = ()


def sweep(jobs: Sequence[Job], command: str, asked: Asked, folder: Path) -> bool:
    """Runs the jobs that are not done, prints and writes what came of all; whether all are done.

    Raises:
        InputError: what runs the jobs is missing, or refuses them.
        KeyboardInterrupt: the jobs that ran have been ended, and can be continued.
    """
    write_jobs(jobs, command)
    left = [job for job in jobs if status_of(job.folder).state != "done"]
    beside = asked.at_once or cores()
    if left:
        before = f", {len(jobs) - len(left)} are done" if len(left) < len(jobs) else ""
        print(f"{command}: {len(left)} jobs{before}; {said_of(asked)}", flush=True)
        with engine_of(asked, folder) as engine, progress(len(left), "jobs") as show:
            run_all(engine, [job.path for job in left], lambda over, bad: show(over, f"{bad} not done" if bad else ""))
    found = entries(jobs)
    names = names_in(found, asked.metric, asked.error, largest=asked.largest)
    best, of = best_of(found, names), groups(found, asked.over, names)
    facts = {"command": command, "where": asked.where, "at_once": None if asked.where == "slurm" else beside}
    write_tables(folder, found, best, of, names, **facts)
    if figure := drawn(found, best, of, asked.over, names, beside=beside if asked.where != "slurm" else 1):
        write_figure(folder / "sweep.png", figure)
    print_jobs(found, best, names, title=f"{command}, {len(jobs)} jobs")
    if asked.over:
        print_groups(of, names, asked.over)
    conclude(found, best, names, folder)
    return all(entry.status.state == "done" for entry in found)


def engine_of(asked: Asked, folder: Path) -> AbstractContextManager[Engine]:
    """What runs the jobs; errors as it is entered."""
    at_once = asked.at_once or asked.gpus or cores()
    if asked.where == "slurm":
        return slurm(folder, asked.at_once, asked.slurm)
    return ray(at_once, asked.gpus) if asked.where == "ray" else here(at_once, asked.gpus)


def said_of(asked: Asked) -> str:
    """Where the jobs run, in words."""
    if asked.where == "slurm":
        return "an array of the cluster"
    return f"{asked.where}, {asked.at_once or asked.gpus or cores()} at once"


def conclude(found: Sequence[Entry], best: Sequence[Entry], names: Names, folder: Path) -> None:
    """Prints what was chosen and by what, what is not done, and where everything is."""
    if names.validation is None:
        print("no job has a validation error: none is chosen; --metric names another number of metrics.json")
    elif not best:
        known = sorted({name for entry in found for name in entry.metrics})
        print(f"no job has {names.validation}: none is chosen; --metric takes one of {', '.join(known) or 'none'}")
    for entry in best:
        values = " ".join(f"{name}={text}" for name, text in entry.job.values.items())
        print(f"best by {names.validation}: {values}, run folder {entry.job.folder / entry.status.run}")
    if best and names.error:
        print(f"{names.error} is of the test, and took no part in the choice")
    if wrong := [entry for entry in found if entry.status.state != "done"]:
        lines = collections.Counter(said(entry) for entry in wrong)
        print(undone(found), *(f"  {count} x {line}" for line, count in lines.most_common()), sep="\n")
        print(f"--out {folder} --resume does them again")
    print(f"sweep: {folder}")
