"""Runs the jobs of a sweep by any executor with futures; the contexts here yield the argument `submit` of `run`."""

import contextlib
import importlib
import io
import os
import queue
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from dln_jax.commands.sweeps.jobs import SECONDS_BETWEEN_LOOKS, STATUS, Job, pairs, run_job, status_of
from dln_jax.files import write_json
from dln_jax.types import InputError

Submit = Callable[[Callable[..., None], Sequence[Job]], Sequence[Any]]
"""(function, jobs) -> a future for each job, with `done()` and `cancel()`, such as `dask.distributed.Client().map`."""
MINUTES, TIMEOUTS = 60, 20
"""Time limit of a Slurm job in minutes, and how often submitit requeues a job that reaches it."""
MOST_IN_ARRAY = 1000
"""Largest number of jobs in an array, Slurm's default MaxArraySize."""


def run(
    jobs: Sequence[Job],
    submit: Submit,
    report: Callable[[int, int], None] = lambda ended, bad: None,
) -> None:
    """Runs jobs until all have ended; records jobs that ended without a status as killed.

    Args:
        jobs: the jobs; the executor's processes must see their folders.
        submit: starts a function of a job for all jobs.
        report: called with the number of jobs that have ended, and how many of these are not done.
    """
    for job in jobs:
        job.folder.mkdir(parents=True, exist_ok=True)
        write_json(job.folder / STATUS, status_of(job.folder)._replace(state="missing", line="")._asdict())
    waiting, bad = list(zip(jobs, submit(run_job, jobs), strict=True)), 0
    try:
        while waiting:
            ended = [(job, future) for job, future in waiting if future.done()]
            if not ended:
                time.sleep(SECONDS_BETWEEN_LOOKS)
            waiting = [pair for pair in waiting if pair not in ended]
            for job, future in ended:
                status = status_of(job.folder)
                if status.state in ("missing", "running"):  # the job has not stored its end
                    word = getattr(future, "state", "")  # Slurm's state, such as OUT_OF_MEMORY
                    how = "did not start" if status.state == "missing" else "ended without a status"
                    line = f"{how} ({word})" if isinstance(word, str) and word else how
                    status = status._replace(state="killed", line=line)
                    write_json(job.folder / STATUS, status._asdict())
                bad += status.state != "done"
            report(len(jobs) - len(waiting), bad)
    except BaseException:
        for _, future in waiting:
            future.cancel()
        raise


@contextlib.contextmanager
def here(at_once: int, gpus: int) -> Iterator[Submit]:
    """Runs jobs as processes of this machine; leaving the context interrupts the ones that still run.

    A process gets its share of the cores as XLA threads, one BLAS thread, and one GPU or none, of those that the user's
    CUDA_VISIBLE_DEVICES names. Other variables that the user has set keep their values.

    Raises:
        InputError: CUDA_VISIBLE_DEVICES names fewer GPUs.
    """
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = visible.split(",") if visible else [str(number) for number in range(gpus)]
    if len(names) < gpus:
        raise InputError(f"--gpus is {gpus}, but CUDA_VISIBLE_DEVICES names {len(names)} of them: {visible}")
    free = queue.SimpleQueue[str]()
    for name in names[:gpus]:
        free.put(name)
    shares = {"OPENBLAS_NUM_THREADS": "1", "NPROC": str(max(1, cores() // at_once))}
    interrupt = threading.Event()

    def work(function: Callable[..., None], job: Job) -> None:
        device = free.get() if gpus else ""
        try:
            function(job, {**shares, **os.environ, "CUDA_VISIBLE_DEVICES": device}, interrupt)
        finally:
            free.put(device)

    pool = ThreadPoolExecutor(at_once)
    try:
        yield lambda function, jobs: [pool.submit(work, function, job) for job in jobs]
    finally:
        interrupt.set()
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def slurm(folder: Path, at_once: int | None, options: str, jobs: int) -> Iterator[Submit]:
    """Runs jobs as one array of a Slurm cluster, by submitit.

    Args:
        folder: folder of the sweep, which all hosts must see.
        at_once: jobs of the array that run at once; None: as many as Slurm allows.
        options: options of sbatch under submitit's names: "partition=gpu time=60 gpus_per_node=1".
        jobs: number of jobs.

    Raises:
        InputError: Slurm is not installed here or refuses the array, or submitit does not know an option.
    """
    submitit = required("submitit", "sweep")
    if missing := [name for name in ("sbatch", "srun", "sacct", "scancel") if shutil.which(name) is None]:
        raise InputError(f"--where slurm: no {missing[0]} on the PATH; call it on a host of the cluster")
    if jobs > MOST_IN_ARRAY:
        raise InputError(f"{jobs} jobs for one Slurm array; expected at most {MOST_IN_ARRAY}; split the grid")
    parameters: dict[str, Any] = {"job_name": folder.name, "time": MINUTES}
    parameters |= {} if at_once is None else {"array_parallelism": at_once}
    for name, value in pairs("--slurm", options).items():
        number = value.isdecimal() and len(value) < 10
        if name == "time" and not number:
            raise InputError(f"--slurm: time is {value!r:.40}; expected whole minutes")
        parameters[name] = int(value) if number else [value] if name in ("setup", "teardown") else value
    executor = submitit.SlurmExecutor(folder=folder / "submitit", max_num_timeout=TIMEOUTS)
    try:
        executor.update_parameters(**parameters)
    except (NameError, TypeError, ValueError, AssertionError) as error:
        raise InputError(f"--slurm: {' '.join(str(error).split())[:300]}") from None

    def submit(function: Callable[..., None], jobs: Sequence[Job]) -> Sequence[Any]:
        try:
            with contextlib.redirect_stderr(io.StringIO()):  # submitit prints what it raises
                return executor.map_array(Requeued(function), jobs)
        except submitit.core.utils.FailedJobError as error:
            raise InputError(f"--where slurm: {' '.join(str(error).split())[-300:]}") from None

    try:
        yield submit
    finally:
        # submitit exchanges jobs and results as pickles; nothing reads them again.
        for pickle in (folder / "submitit").glob("*.pkl"):
            pickle.unlink(missing_ok=True)


class Requeued(NamedTuple):
    """A function whose job submitit queues again, unchanged, after a timeout or preemption."""

    function: Callable[..., None]

    def __call__(self, *arguments: Any) -> None:
        """Calls the function."""
        self.function(*arguments)

    def checkpoint(self, *arguments: Any) -> Any:
        """Called by submitit before the job is queued again."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, *arguments)


@contextlib.contextmanager
def ray(at_once: int, gpus: int) -> Iterator[Submit]:
    """Runs jobs as Ray tasks, on the cluster of RAY_ADDRESS or on this machine, with one core and at most one GPU."""
    package = required("ray", "ray")
    if os.environ.get("RAY_ADDRESS"):
        package.init(log_to_driver=False)
    else:
        own = {"num_cpus": at_once, "num_gpus": gpus, "include_dashboard": False}
        package.init(address="local", log_to_driver=False, logging_level="ERROR", **own)
    threads = {"env_vars": {"OPENBLAS_NUM_THREADS": "1", "NPROC": "1"}}
    task = package.remote(num_cpus=1, num_gpus=min(gpus, 1), max_retries=0, runtime_env=threads)
    try:
        yield lambda function, jobs: [task(function).remote(job).future() for job in jobs]
    finally:
        package.shutdown()


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def required(package: str, extra: str) -> ModuleType:
    """Imports an executor's package; `InputError` names the extra that installs it if it is missing."""
    try:
        return importlib.import_module(package)
    except ImportError:
        raise InputError(f"{package} is not installed; pip install 'dln-jax[{extra}]'") from None
