"""One job, in a process of its own, wherever an engine has put it: the command runs, and its end is written down."""

import contextlib
import os
import runpy
import signal
import socket
import sys
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from filelock import FileLock

from dln_jax.files import is_file
from dln_jax.interrupts import terminate_as_interrupt
from dln_jax.sweeps.plan import read_job
from dln_jax.sweeps.status import OUTPUT, Status, end, status_of, write_status
from dln_jax.types import InputError
from dln_jax.zoo.run_folder import CONFIG, LOCK

REQUEUED = (-1, 144)
"""Exit codes by which submitit leaves a job that it has put into the queue again."""
INTERRUPTED = 130


class Work:
    """What an engine is given, with the path of a job's file; submitit pickles this name and that path only."""

    def __call__(self, path: str) -> None:
        """Does the job; raises `SystemExit` with the command's exit code unless that is 0."""
        # A sweep that was started in the background has jobs that would ignore an interrupt.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if code := perform(Path(path)):
            raise SystemExit(code)

    def checkpoint(self, path: str) -> Any:
        """What submitit queues before the job's time is up or as it is preempted: the same job, which resumes."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, path)


def perform(path: Path) -> int:
    """Runs the command of a job's file in this process, and gives its exit code.

    A job that is done is not done again. One that was begun is continued with --resume if its command can, else begun
    anew in another folder. Two processes never do one job at once: the second waits for the first.
    """
    folder = path.parent
    if not is_file(path):
        raise InputError(f"{path}: no such file; give the job.json of a sweep's job")
    with FileLock(folder / LOCK):
        job = read_job(path)
        before = status_of(folder)
        if before.state == "done":
            return 0
        attempt = before.attempt + 1
        run = folder / (before.run or "run")
        resume = job["resumes"] and (run / CONFIG).is_file()
        if not resume and run.exists():
            run = folder / f"run-{attempt}"
        status = Status("running", attempt=attempt, run=run.name, host=socket.gethostname(), process=os.getpid())
        write_status(folder, status)
        line = [job["command"], *job["arguments"], f"--out={run}", *["--resume"] * resume]
        begun = time.monotonic()
        with (folder / OUTPUT).open("a", buffering=1, encoding="utf-8") as output:
            start = output.tell()
            with said_to(output), contextlib.chdir(job["folder"]):
                code = exit_code(line)
        seconds = time.monotonic() - begun
        if code == 0:
            write_status(folder, status._replace(state="done", seconds=seconds))
        elif code == INTERRUPTED:
            end(folder, "interrupted")
        else:
            line = last_line(folder / OUTPUT, start)
            write_status(folder, status._replace(state="failed", line=line, seconds=seconds))
        return code


def exit_code(line: list[str]) -> int:
    """Runs `python -m dln_jax LINE` in this process; `SystemExit` if an engine has queued the job again meanwhile."""
    before = sys.argv
    sys.argv = ["dln_jax", *line]
    try:
        runpy.run_module("dln_jax", run_name="__main__", alter_sys=True)
    except SystemExit as stop:
        if stop.code in REQUEUED:
            raise
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except Exception:
        traceback.print_exc()
        return 1
    finally:
        sys.argv = before
    return 0


@contextlib.contextmanager
def said_to(output: Any) -> Iterator[None]:
    """Sends what this process prints into a file, also what is printed below Python."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(descriptor) for descriptor in (1, 2)]
    try:
        for descriptor in (1, 2):
            os.dup2(output.fileno(), descriptor)
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            yield
    finally:
        for descriptor, before in zip((1, 2), kept, strict=True):
            os.dup2(before, descriptor)
            os.close(before)


def last_line(path: Path, start: int = 0) -> str:
    """What a command said last behind `start`, its error if it said one, on one line."""
    try:
        with path.open("rb") as file:
            file.seek(start)
            lines = [line.strip() for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    except OSError:
        return ""
    errors = [line for line in lines if line.startswith("error: ")]
    return (errors or lines or [""])[-1].removeprefix("error: ")[:300]


if __name__ == "__main__":
    terminate_as_interrupt()
    try:
        if len(sys.argv) != 2:
            raise InputError("expected one argument: the job.json of a sweep's job")
        raise SystemExit(perform(Path(sys.argv[1])))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
