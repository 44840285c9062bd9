"""Jobs on this machine, so many at once, by submitit's local executor."""

import contextlib
import os
import signal
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from dln_jax.sweeps.engines import Engine, required
from dln_jax.sweeps.work import Work, last_line

LOGS = "submitit"
MINUTES = 60 * 24 * 365
"""A job ends when it ends: submitit's own limit would be two minutes."""
SECONDS_TO_END = 3.0
"""For jobs that were interrupted by the terminal too, before they are told."""


class Started(NamedTuple):
    """A job of submitit's, and the accelerator that it has."""

    job: Any
    gpu: int | None


@contextlib.contextmanager
def here(at_once: int, gpus: int) -> Iterator[Engine]:
    """Yields the engine.

    Each of `at_once` jobs gets its share of the cores, as the number of threads that XLA has; BLAS has one. With `gpus`
    each job has one of them to itself, without, none.
    """
    submitit = required("submitit", "sweep")
    free = list(range(gpus))
    threads = str(max(1, cores() // at_once))

    def start(paths: Sequence[Path]) -> list[Started]:
        started = []
        for path in paths:
            gpu = free.pop(0) if gpus else None
            executor = submitit.LocalExecutor(folder=path.parent / LOGS)
            seen = {} if gpu is None else {"gpus_per_node": 1, "visible_gpus": (gpu,)}
            executor.update_parameters(timeout_min=MINUTES, **seen)
            shares = environment({"OPENBLAS_NUM_THREADS": "1", "NPROC": threads})
            with shares, errors_to(path.parent / LOGS / "controller.txt"):
                started.append(Started(executor.submit(Work(), str(path)), gpu))
        return started

    def over(handle: Started) -> str | None:
        if not handle.job.done():
            return None
        if handle.gpu is not None:
            free.append(handle.gpu)
        forget(handle.job)
        # What was killed says nothing; what did not start says why.
        return last_line(handle.job.paths.stderr)

    def stop(handles: Sequence[Started]) -> None:
        wait(handles)
        for number in (signal.SIGINT, signal.SIGKILL):
            for handle in handles:
                if not handle.job.done():
                    end_processes(handle.job, number)
            wait(handles)
        for handle in handles:
            forget(handle.job)

    yield Engine(start, over, stop, at_once)


@contextlib.contextmanager
def errors_to(path: Path) -> Iterator[None]:
    """Gives processes that are started a file for their errors: submitit's have a trace to say of an interrupt."""
    kept = os.dup(2)
    try:
        with path.open("ab") as file:
            os.dup2(file.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def end_processes(job: Any, number: signal.Signals) -> None:
    """Sends a signal to a job's own process, or, if it may not refuse, to submitit's that looks after it too.

    submitit's own way is an interrupt of the latter, which ignores it where this process was started in the background.
    """
    controller = int(job.job_id)
    children = Path(f"/proc/{controller}/task/{controller}/children")
    try:
        started = [int(word) for word in children.read_text().split()]
    except OSError:  # it has ended, or the system is not Linux
        started = []
    if not started or number == signal.SIGKILL:
        job.cancel() if number == signal.SIGINT else started.append(controller)
    for process in started:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, number)


def forget(job: Any) -> None:
    """Removes the pickles by which submitit hands a job over: what they say is in the job's own files."""
    for path in (job.paths.submitted_pickle, job.paths.result_pickle):
        path.unlink(missing_ok=True)


def cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def wait(handles: Sequence[Started]) -> None:
    """Until jobs have ended, or for some seconds."""
    until = time.monotonic() + SECONDS_TO_END
    while time.monotonic() < until and not all(handle.job.done() for handle in handles):
        time.sleep(0.05)


@contextlib.contextmanager
def environment(values: dict[str, str]) -> Iterator[None]:
    """Sets variables for processes that are started; what the user has set stays."""
    new = {name: value for name, value in values.items() if name not in os.environ}
    os.environ.update(new)
    try:
        yield
    finally:
        for name in new:
            del os.environ[name]
