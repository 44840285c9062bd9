"""Jobs as one array of a Slurm cluster, by submitit."""

import contextlib
import io
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dln_jax.files import is_file, read_json, write_json
from dln_jax.sweeps.engines import Engine, required
from dln_jax.sweeps.grid import pairs
from dln_jax.sweeps.here import forget
from dln_jax.sweeps.plan import closest
from dln_jax.sweeps.status import status_of
from dln_jax.sweeps.work import Work
from dln_jax.types import InputError

MOST_JOBS = 1000
"""Of one array, by Slurm's default MaxArraySize."""
MINUTES = 60
"""After which Slurm ends a job, by default; it is queued again and continues, so often at most:"""
TIMEOUTS = 20
IDS = "slurm.json"
"""File in the sweep's folder with the jobs' numbers in Slurm, by which a resumed sweep finds those that still run."""


@contextlib.contextmanager
def slurm(folder: Path, jobs: int, at_once: int | None, options: str) -> Iterator[Engine]:
    """Yields the engine.

    Args:
        folder: of the sweep, which all hosts must see.
        jobs: how many there are.
        at_once: jobs of the array that run beside each other; None: as many as Slurm allows.
        options: of sbatch, by the names that submitit has for them: "partition=gpu time=60 gpus_per_node=1".

    Raises:
        InputError: no Slurm here, more jobs than an array holds, or an option that submitit does not know.
    """
    submitit = required("submitit", "sweep")
    if missing := [name for name in ("sbatch", "srun", "sacct", "scancel") if shutil.which(name) is None]:
        raise InputError(f"--where slurm: no {missing[0]} on the PATH; call it on a host of the cluster")
    if jobs > MOST_JOBS:
        raise InputError(f"{jobs} jobs for one Slurm array; expected at most {MOST_JOBS}; split the grid")
    executor = submitit.SlurmExecutor(folder=folder / "submitit", max_num_timeout=TIMEOUTS)
    limit = {} if at_once is None else {"array_parallelism": at_once}
    given = parameters(options, sorted(executor._valid_parameters()))
    executor.update_parameters(**{"job_name": folder.name, "time": MINUTES, **limit, **given})

    def start(paths: Sequence[Path]) -> list[tuple[Path, Any]]:
        known = read_json(folder / IDS, remedy="remove it") if is_file(folder / IDS) else {}
        found = {path: still_there(submitit.SlurmJob, executor.folder, known.get(path.parent.name)) for path in paths}
        new = [path for path, job in found.items() if job is None]
        if new:
            try:
                with contextlib.redirect_stderr(io.StringIO()):  # submitit prints what it raises
                    found |= zip(new, executor.map_array(Work(), map(str, new)), strict=True)
            except submitit.core.utils.FailedJobError as error:
                raise InputError(f"--where slurm: {' '.join(str(error).split())[-300:]}") from None
        write_json(folder / IDS, known | {path.parent.name: job.job_id for path, job in found.items()})
        return list(found.items())

    yield Engine(start, over, stop, at_once=10**9)


def parameters(options: str, known: Sequence[str]) -> dict[str, Any]:
    """The values of --slurm; `InputError` for a name that is not `known`."""
    found: dict[str, Any] = pairs("--slurm", options)
    for name, text in found.items():
        if name not in known:
            raise InputError(f"--slurm has no {name}{closest(name, known)}; there are {', '.join(known)}")
        number = text.isdecimal() and len(text) < 10
        if name == "time" and not number:
            raise InputError(f"--slurm: time is {text!r:.40}; expected whole minutes")
        found[name] = int(text) if number else [text] if name in ("setup", "teardown") else text
    return found


def still_there(kind: Any, folder: Path, number: str | None) -> Any:
    """The job of a number that an earlier call has submitted, if it still waits or runs."""
    if number is None:
        return None
    job = kind(folder=folder, job_id=number)
    state = job.get_info(mode="force").get("State", "UNKNOWN")
    return None if state == "UNKNOWN" or job.watcher.is_done(number, mode="cache") else job


def over(handle: tuple[Path, Any]) -> str | None:
    """Whether a job is; its own file says so at once, and Slurm is asked now and then."""
    path, job = handle
    if status_of(path.parent).state in ("done", "failed", "killed"):
        forget(job)
        return ""
    return job.state if job.done() and job.state != "SUSPENDED" else None


def stop(handles: Sequence[tuple[Path, Any]]) -> None:
    """Takes jobs out of the queue, or ends them."""
    subprocess.call(["scancel", *(job.job_id for _, job in handles)])
