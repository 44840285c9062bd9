"""One job of a sweep: a command in its own process, and a status file in its folder that records how it ended."""

import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from filelock import FileLock

from dln_jax.files import as_type, is_file, read_json, write_json
from dln_jax.runs.folder import CONFIG, LOCK
from dln_jax.runs.running import INTERRUPTED
from dln_jax.types import InputError

STATUS = "status.json"
OUTPUT = "output.txt"
"""Standard output and errors of the command."""
METRICS = "metrics.json"
"""File in the run's folder with the numbers to compare."""
SECONDS_BETWEEN_LOOKS = 0.1
SECONDS_TO_END = 10.0
"""Time that an interrupted command has to store its last checkpoint, before it is killed."""
_RUN = re.compile(r"run(-\d{1,9})?")
"""Names of the run folders that a job creates."""
State = Literal["missing", "running", "done", "failed", "killed"]


class Status(NamedTuple):
    """Progress of a job."""

    state: State = "missing"
    line: str = ""
    """Reason if the job is not done: the command's error message, or the signal that ended it."""
    attempt: int = 0
    run: str = "run"
    """Name of the run's folder within the job's folder."""
    seconds: float | None = None
    """Duration of the last attempt."""


class Job(NamedTuple):
    """One run of a command."""

    folder: Path
    command: str
    arguments: tuple[str, ...]
    """Arguments of the command line, without --out and --resume."""
    values: Mapping[str, str]
    """Grid values by option, as typed."""
    resumes: bool
    """Whether the command can continue an interrupted run."""
    directory: Path
    """Working directory of the command."""

    def line(self, run: Path) -> list[str]:
        """The command line that writes its run into this folder."""
        return [sys.executable, "-m", "dln_jax", self.command, *self.arguments, f"--out={run}"]


def run_job(job: Job, environment: Mapping[str, str] | None = None, interrupt: threading.Event | None = None) -> None:
    """Runs a job's command and stores its status; any executor may call this in a process that sees the job's folder.

    A finished job is not repeated. An interrupted one continues with --resume if its command supports that, else it
    starts again in another folder. If two processes call the same job, the second waits for the first.

    Args:
        environment: environment variables of the command; default: those of this process.
        interrupt: ends the command when it is set.
    """
    interrupt = interrupt or threading.Event()
    job.folder.mkdir(parents=True, exist_ok=True)
    with FileLock(job.folder / LOCK):
        before = status_of(job.folder)
        if before.state == "done":
            return
        attempt, run = before.attempt + 1, job.folder / before.run
        resume = job.resumes and (run / CONFIG).is_file()
        if run.exists() and not resume:
            run = job.folder / f"run-{attempt}"
        status = Status("running", attempt=attempt, run=run.name)
        write_json(job.folder / STATUS, status._asdict())
        began = time.monotonic()
        with (job.folder / OUTPUT).open("ab") as output:
            first = output.tell()
            streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": output}
            line = [*job.line(run), *["--resume"] * resume]
            process = subprocess.Popen(line, cwd=job.directory, env=environment and dict(environment), **streams)
            try:
                while process.poll() is None and not interrupt.wait(SECONDS_BETWEEN_LOOKS):
                    pass
            finally:
                process.terminate()  # our commands treat it as Ctrl-C; a background process would ignore Ctrl-C itself
                try:
                    process.wait(SECONDS_TO_END)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
        state, reason = _outcome(process.returncode, job.folder / OUTPUT, first)
        status = status._replace(state=state, line=reason, seconds=time.monotonic() - began)
        write_json(job.folder / STATUS, status._asdict())


def status_of(folder: Path) -> Status:
    """Reads the status of the job in a folder. A job run by other means counts as done if its metrics exist.

    Raises:
        InputError: the status file is damaged, or names a run that is not in the job's folder.
    """
    path, remedy = folder / STATUS, "remove it, and --resume does the job again"
    if not is_file(path):
        return Status("done" if is_file(folder / "run" / METRICS) else "missing")
    stored = read_json(path, remedy=remedy)
    values = [stored.get(name, default) for name, default in Status._field_defaults.items()]
    status = as_type(values, Status, name=str(path), remedy=remedy)
    if status.attempt < 0 or not _RUN.fullmatch(status.run) or (folder / status.run).is_symlink():
        raise InputError(f"{path}: attempt {status.attempt}, run '{status.run:.60}' are not those of a job; {remedy}")
    if status.state == "done" and not any((folder / status.run).glob("*")):
        return Status(line="its run is gone", attempt=status.attempt)
    return status


def _outcome(code: int, output: Path, first: int) -> tuple[State, str]:
    """State and reason of a job, from its exit status and its output after the byte `first`."""
    if code == 0:
        return "done", ""
    if code in (INTERRUPTED, -signal.SIGINT, -signal.SIGTERM):
        return "killed", "interrupted"
    if code < 0:
        return "killed", f"ended by {signal.Signals(-code).name}"
    text = output.read_bytes()[first:].decode(errors="replace")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]
    return "failed", (errors or lines or [""])[-1].removeprefix("error: ")[:300]
