"""Run a sweep: execute the jobs that are not done, and compare all of them."""

import shlex
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Literal, NamedTuple

from dln_jax.cli.progress import progress
from dln_jax.cli.sweeps.drawing import drawn, undone
from dln_jax.cli.sweeps.executors import Submit, cores, here, ray, slurm
from dln_jax.cli.sweeps.job import STATUS, Job, status_of
from dln_jax.cli.sweeps.results import ERRORS, Entry, Names, best_of, entries, groups, names_in, require_known
from dln_jax.cli.sweeps.tables import print_groups, print_jobs, write_tables
from dln_jax.files import write_figure, write_json

SECONDS_BETWEEN_LOOKS = 0.2
LATER = "jobs.sh"
"""File in the sweep's folder with the command lines of the jobs, for --where later."""


class Asked(NamedTuple):
    """How to run a sweep and compare its jobs; `None` is the default stated in the command's help."""

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
        """Number of jobs at once; `None` if Slurm decides."""
        return self.at_once or (None if self.where == "slurm" else self.gpus or cores())


def sweep(jobs: Sequence[Job], asked: Asked, folder: Path) -> bool:
    """Runs the jobs that are not done, prints and writes the results of all, and returns whether all are done.

    Raises:
        InputError: the executor is missing or refuses the jobs, or no job has a requested metric.
        KeyboardInterrupt: running jobs have been interrupted and can be resumed.
    """
    left = [job for job in jobs if status_of(job.folder).state != "done"]
    if asked.where == "later":
        (folder / LATER).write_text("".join(f"{shlex.join(job.line(job.folder / 'run'))}\n" for job in left))
        print(f"{len(left)} jobs, a line each in {folder / LATER}, to be run from {Path.cwd()}")
        print(f"the table is made by: --out {folder} --resume --where here")
        return True
    if left:
        done = f", {len(jobs) - len(left)} are done" if len(left) < len(jobs) else ""
        beside = "an array of the cluster" if asked.beside is None else f"{asked.beside} at once"
        with executor_of(asked, folder) as submit, progress(len(left), "jobs") as show:
            print(f"{jobs[0].command}: {len(left)} of {len(jobs)} jobs{done}; {asked.where}, {beside}", flush=True)
            run(left, submit, lambda over, bad: show(over, f"{bad} not done" if bad else ""))
    found = entries(jobs)
    require_known(found, metric=asked.metric, error=asked.error)
    names = names_in(found, asked.metric, asked.error, largest=asked.largest)
    best, of = best_of(found, names), groups(found, asked.over, names)
    write_tables(folder, found, best, of, names, command=jobs[0].command, where=asked.where, at_once=asked.beside)
    if figure := drawn(found, best, of, asked.over, names, beside=asked.beside):
        write_figure(folder / "sweep.png", figure)
    print_jobs(found, best, names, title=f"{jobs[0].command}, {len(jobs)} jobs")
    if asked.over:
        print_groups(of, names, asked.over)
    conclude(found, best, names, folder)
    return all(entry.status.state == "done" for entry in found)


def run(jobs: Sequence[Job], submit: Submit, report: Callable[[int, int], None] = lambda over, bad: None) -> None:
    """Runs jobs by any executor until all have ended; records jobs that ended without a status as killed.

    Args:
        jobs: functions without arguments, which an executor may call wherever their folders are visible.
        submit: jobs -> futures, which have `done()` and `cancel()`: `lambda jobs: [pool.submit(job) for job in jobs]`.
        report: called with the number of jobs that have ended, and how many of these are not done.
    """
    for job in jobs:
        job.folder.mkdir(parents=True, exist_ok=True)
        status = status_of(job.folder)
        write_json(job.folder / STATUS, status._replace(state="missing", line="")._asdict())
    waiting = list(zip(jobs, submit(jobs), strict=True))
    bad = 0
    try:
        while waiting:
            time.sleep(SECONDS_BETWEEN_LOOKS)
            over = [(job, future) for job, future in waiting if future.done()]
            waiting = [each for each in waiting if each not in over]
            bad += sum(_closed(job, future) != "done" for job, future in over)
            report(len(jobs) - len(waiting), bad)
    except BaseException:
        for _, future in waiting:
            future.cancel()
        raise


def executor_of(asked: Asked, folder: Path) -> AbstractContextManager[Submit]:
    """The executor of the jobs; entering the context may raise its errors."""
    if asked.where == "slurm":
        return slurm(folder, asked.beside, asked.slurm)
    at_once = asked.beside or 1
    return ray(at_once, asked.gpus) if asked.where == "ray" else here(at_once, asked.gpus)


def conclude(found: Sequence[Entry], best: Sequence[Entry], names: Names, folder: Path) -> None:
    """Prints the best jobs and the metric that chose them, the jobs that are not done, and the sweep's folder."""
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


def _closed(job: Job, future: object) -> str:
    """Final state of a job whose future is done; a job that has not stored its end is recorded as killed."""
    status = status_of(job.folder)
    if status.state in ("missing", "running"):
        word = getattr(future, "state", "")  # Slurm's state, such as OUT_OF_MEMORY
        how = "did not start" if status.state == "missing" else "ended without a word"
        line = f"{how} ({word})" if isinstance(word, str) and word else how
        status = status._replace(state="killed", line=line)
        write_json(job.folder / STATUS, status._asdict())
    return status.state
