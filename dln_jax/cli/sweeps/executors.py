"""Executors of a sweep: contexts that yield a function from jobs to futures (`done()`, `cancel()`)."""

import contextlib
import importlib
import io
import os
import queue
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from subprocess import Popen
from types import ModuleType
from typing import Any

from dln_jax.cli.sweeps.grid import pairs
from dln_jax.cli.sweeps.job import Job, end_processes
from dln_jax.types import InputError

Submit = Callable[[Sequence[Job]], Sequence[Any]]
"""Jobs -> their futures."""
MOST_JOBS = 1000
"""Largest number of jobs in an array, Slurm's default MaxArraySize."""
MINUTES, TIMEOUTS = 60, 20
"""Time limit of a Slurm job in minutes, and how often submitit requeues a job that reaches it."""


@contextlib.contextmanager
def here(at_once: int, gpus: int) -> Iterator[Submit]:
    """Runs jobs as processes of this machine.

    A process gets its share of the cores as XLA threads, one BLAS thread, and one GPU or none, of those that the user's
    CUDA_VISIBLE_DEVICES names. Other variables that the user has set keep their values.

    Raises:
        InputError: CUDA_VISIBLE_DEVICES names fewer GPUs.
    """
    running: list[Popen] = []
    ending = threading.Event()
    free = queue.SimpleQueue[str]()
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = visible.split(",") if visible else [str(number) for number in range(gpus)]
    if len(names) < gpus:
        raise InputError(f"--gpus is {gpus}, but CUDA_VISIBLE_DEVICES names {len(names)} of them: {visible}")
    for name in names[:gpus]:
        free.put(name)
    shares = {"OPENBLAS_NUM_THREADS": "1", "NPROC": str(max(1, cores() // at_once))}

    def started(process: Popen) -> None:
        running.append(process)
        if ending.is_set():
            process.terminate()

    def work(job: Job) -> None:
        device = free.get() if gpus else ""
        try:
            job({**shares, **os.environ, "CUDA_VISIBLE_DEVICES": device}, started)
        finally:
            free.put(device)

    pool = ThreadPoolExecutor(at_once)
    try:
        yield lambda jobs: [pool.submit(work, job) for job in jobs]
    except BaseException:
        ending.set()
        pool.shutdown(wait=False, cancel_futures=True)
        end_processes([process for process in running if process.poll() is None])
        raise
    finally:
        pool.shutdown()


@contextlib.contextmanager
def slurm(folder: Path, at_once: int | None, options: str) -> Iterator[Submit]:
    """Runs jobs as one array of a Slurm cluster, by submitit.

    Args:
        folder: folder of the sweep, which all hosts must see.
        at_once: jobs of the array that run at once; None: as many as Slurm allows.
        options: options of sbatch under submitit's names: "partition=gpu time=60 gpus_per_node=1".

    Raises:
        InputError: Slurm is not installed here, the array is too large, or submitit does not know an option.
    """
    submitit = required("submitit", "sweep")
    if missing := [name for name in ("sbatch", "srun", "sacct", "scancel") if shutil.which(name) is None]:
        raise InputError(f"--where slurm: no {missing[0]} on the PATH; call it on a host of the cluster")
    executor = submitit.SlurmExecutor(folder=folder / "submitit", max_num_timeout=TIMEOUTS)
    try:
        limit = {} if at_once is None else {"array_parallelism": at_once}
        executor.update_parameters(**{"job_name": folder.name, "time": MINUTES, **limit, **sbatch_options(options)})
    except (NameError, TypeError, ValueError, AssertionError) as error:
        raise InputError(f"--slurm: {' '.join(str(error).split())[:300]}") from None

    def submit(jobs: Sequence[Job]) -> Sequence[Any]:
        if len(jobs) > MOST_JOBS:
            raise InputError(f"{len(jobs)} jobs for one Slurm array; expected at most {MOST_JOBS}; split the grid")
        try:
            with contextlib.redirect_stderr(io.StringIO()), executor.batch():  # submitit prints what it raises
                futures = [executor.submit(job) for job in jobs]
        except submitit.core.utils.FailedJobError as error:
            raise InputError(f"--where slurm: {' '.join(str(error).split())[-300:]}") from None
        return futures

    try:
        yield submit
    finally:
        # submitit exchanges jobs and results as pickles; nothing reads them again.
        for left in (folder / "submitit").glob("*.pkl"):
            left.unlink(missing_ok=True)


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
    task = package.remote(num_cpus=1, num_gpus=min(gpus, 1), max_retries=0, runtime_env=threads)(perform)
    try:
        yield lambda jobs: [task.remote(job).future() for job in jobs]
    finally:
        package.shutdown()


def perform(job: Job) -> None:
    """Runs a job: a plain function, for executors that accept no other callable."""
    job()


def sbatch_options(text: str) -> dict[str, Any]:
    """Parses --slurm into submitit's parameters; `InputError` if the time is not in whole minutes."""
    found: dict[str, Any] = {}
    for name, value in pairs("--slurm", text).items():
        number = value.isdecimal() and len(value) < 10
        if name == "time" and not number:
            raise InputError(f"--slurm: time is {value!r:.40}; expected whole minutes")
        found[name] = int(value) if number else [value] if name in ("setup", "teardown") else value
    return found


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def required(package: str, extra: str) -> ModuleType:
    """Imports an executor's package; `InputError` names the extra that installs it if it is missing."""
    try:
        return importlib.import_module(package)
    except ImportError:
        raise InputError(f"{package} is not installed; pip install 'dln-jax[{extra}]'") from None
