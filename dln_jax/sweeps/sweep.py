"""A sweep from its jobs to its table: what is not done is run, and everything is shown."""

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
from dln_jax.sweeps.results import ERRORS, Entry, Names, best_of, entries, groups, names_in, require_known
from dln_jax.sweeps.slurm import slurm
from dln_jax.sweeps.status import status_of
from dln_jax.sweeps.tables import print_groups, print_jobs, write_tables


class Asked(NamedTuple):
    """How to run a sweep, and how to compare; None is the default that the command's help states."""

    where: Literal["here", "slurm", "ray", "later"] = "here"
    at_once: int | None = None
    gpus: int = 0
    slurm: str = ""
    metric: str | None = None
    largest: bool = False
    error: str | None = None
    over: tuple[str, ...] = ()

    @property
    def beside(self) -> int | None:
        """Jobs at once; None where that is left to Slurm."""
        return self.at_once or (None if self.where == "slurm" else self.gpus or cores())


def sweep(jobs: Sequence[Job], command: str, asked: Asked, folder: Path) -> bool:
    """Runs the jobs that are not done, prints and writes what came of all; whether all are done.

    Raises:
        InputError: what runs the jobs is missing, or refuses them; or no job has a metric that was asked for.
        KeyboardInterrupt: the jobs that ran have been ended, and can be continued.
    """
    if asked.where == "later":
        write_jobs(jobs, command)
        print(f"{len(jobs)} jobs; each is done by: python -m dln_jax.sweeps.work {folder}/jobs/NUMBER/job.json")
        print(f"and the table is made by: --out {folder} --resume --where here")
        return True
    left = [job for job in jobs if status_of(job.folder).state != "done"]
    if left:
        before = f", {len(jobs) - len(left)} are done" if len(left) < len(jobs) else ""
        beside = "an array of the cluster" if asked.beside is None else f"{asked.beside} at once"
        with engine_of(asked, folder, len(left)) as engine, progress(len(left), "jobs") as show:
            write_jobs(jobs, command)
            print(f"{command}: {len(left)} of {len(jobs)} jobs{before}; {asked.where}, {beside}", flush=True)
            run_all(engine, [job.path for job in left], lambda over, bad: show(over, f"{bad} not done" if bad else ""))
    found = entries(jobs)
    require_known(found, metric=asked.metric, error=asked.error)
    names = names_in(found, asked.metric, asked.error, largest=asked.largest)
    best, of = best_of(found, names), groups(found, asked.over, names)
    write_tables(folder, found, best, of, names, command=command, where=asked.where, at_once=asked.beside)
    if figure := drawn(found, best, of, asked.over, names, beside=asked.beside):
        write_figure(folder / "sweep.png", figure)
    print_jobs(found, best, names, title=f"{command}, {len(jobs)} jobs")
    if asked.over:
        print_groups(of, names, asked.over)
    conclude(found, best, names, folder)
    return all(entry.status.state == "done" for entry in found)


def engine_of(asked: Asked, folder: Path, jobs: int) -> AbstractContextManager[Engine]:
    """What runs the jobs; errors as it is entered."""
    if asked.where == "slurm":
        return slurm(folder, jobs, asked.beside, asked.slurm)
    at_once = asked.beside or 1
    return ray(at_once, asked.gpus) if asked.where == "ray" else here(at_once, asked.gpus)


def conclude(found: Sequence[Entry], best: Sequence[Entry], names: Names, folder: Path) -> None:
    """Prints what was chosen and by what, what is not done, and where everything is."""
    known = sorted({name for entry in found for name in entry.metrics})
    if known and names.validation not in known:
        print(f"no job has a validation error: none is chosen; --metric takes one of {', '.join(known)}")
    for entry in best:
        values = " ".join(f"{name}={text}" for name, text in entry.job.values.items())
        print(f"best by {names.validation}: {values}, run folder {entry.job.folder / entry.status.run}")
    if best and names.error in ERRORS:
        print(f"{names.error} is of the test, and took no part in the choice")
    wrong: dict[str, list[str]] = {}
    for entry in found:
        if entry.status.state != "done":
            wrong.setdefault(f"{entry.status.state}: {entry.status.line}", []).append(entry.job.folder.name)
    if wrong:
        print(undone(found), *(f"  {', '.join(jobs)} {line}" for line, jobs in wrong.items()), sep="\n")
        print(f"--out {folder} --resume does them again")
    print(f"sweep: {folder}")
