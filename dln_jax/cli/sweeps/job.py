"""One job of a sweep: a command in a process of its own, and one small file in its folder that says how it ended."""

import os
import re
import reprlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_type_hints

from filelock import FileLock

from dln_jax.files import in_words, is_file, matches, read_json, write_json
from dln_jax.types import InputError
from dln_jax.zoo.run_folder import CONFIG, LOCK

STATUS = "status.json"
OUTPUT = "output.txt"
"""What the command printed, errors too."""
METRICS = "metrics.json"
"""In the run's folder: what is compared."""
INTERRUPTED = 130
SECONDS_TO_END = 10.0
"""For a command that was interrupted to store its last checkpoint."""
_RUN = re.compile(r"run(-\d{1,9})?")
"""Names of the folders that a job gives to its runs."""
State = Literal["missing", "running", "done", "failed", "killed"]


class Status(NamedTuple):
    """How far a job is."""

    state: State = "missing"
    line: str = ""
    """Why, if it is not done: the command's own line, or what ended it."""
    attempt: int = 0
    run: str = "run"
    """Folder of the run, in the job's."""
    seconds: float | None = None
    """From start to end of the last attempt."""


@dataclass(frozen=True)
class Job:
    """One run of a command, which any executor may call in any process that sees its folder.

    A job that is done is not done again. One that was begun is continued with --resume if its command can, else begun
    anew in another folder. Of two processes that have the same job the second waits for the first.
    """

    folder: Path
    command: str
    arguments: tuple[str, ...]
    """Of the command's line, without --out and --resume."""
    values: Mapping[str, str]
    """Of the grid, as they were typed."""
    resumes: bool
    """Whether the command can continue what was interrupted."""
    directory: Path
    """In which the command runs."""

    def __call__(
        self, environment: Mapping[str, str] = os.environ, started: Callable[[subprocess.Popen], None] | None = None
    ) -> None:
        """Runs the command and stores how it ended.

        Args:
            environment: of the command.
            started: called with its process.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(self.folder / LOCK):
            before = status_of(self.folder)
            if before.state == "done":
                return
            attempt, run = before.attempt + 1, self.folder / before.run
            resume = self.resumes and (run / CONFIG).is_file()
            if run.exists() and not resume:
                run = self.folder / f"run-{attempt}"
            status = Status("running", attempt=attempt, run=run.name)
            write_json(self.folder / STATUS, status._asdict())
            line = [*self.line(run), *["--resume"] * resume]
            began = time.monotonic()
            with (self.folder / OUTPUT).open("ab") as output:
                first = output.tell()
                streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": output}
                process = subprocess.Popen(line, cwd=self.directory, env=dict(environment), **streams)
                if started:
                    started(process)
                try:
                    code = process.wait()
                except BaseException:
                    end_processes([process])
                    raise
            state, reason = _outcome(code, self.folder / OUTPUT, first)
            status = status._replace(state=state, line=reason, seconds=time.monotonic() - began)
            write_json(self.folder / STATUS, status._asdict())

    def line(self, run: Path) -> list[str]:
        """The command's line, for a folder of its run."""
        return [sys.executable, "-m", "dln_jax", self.command, *self.arguments, f"--out={run}"]

    def checkpoint(self, *arguments: Any) -> Any:
        """What submitit queues before the job's time is up or as it is preempted: the same job, which resumes."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, *arguments)


def status_of(folder: Path) -> Status:
    """The status of the job in a folder; one that something else has run is done if its metrics are there.

    Raises:
        InputError: the file is damaged, or names a run that is not in the job's folder.
    """
    path, remedy = folder / STATUS, "remove it, and --resume does the job again"
    if not is_file(path):
        return Status("done" if is_file(folder / "run" / METRICS) else "missing")
    stored = read_json(path, remedy=remedy)
    for name, hint in get_type_hints(Status).items():
        if name in stored and not matches(stored[name], hint):
            raise InputError(f"{path}: {name} is {reprlib.repr(stored[name])}; expected {in_words(hint)}; {remedy}")
    status = Status(**{name: stored[name] for name in Status._fields if name in stored})
    if status.attempt < 0 or not _RUN.fullmatch(status.run) or (folder / status.run).is_symlink():
        raise InputError(f"{path}: attempt {status.attempt}, run '{status.run:.60}' are not those of a job; {remedy}")
    if status.state == "done" and not any((folder / status.run).glob("*")):
        return Status(line="its run is gone", attempt=status.attempt)
    return status


def end_processes(processes: list[subprocess.Popen]) -> None:
    """Interrupts commands, so that they store a checkpoint, and kills those that do not end."""
    for process in processes:
        process.terminate()  # our commands end as by Ctrl-C, which a process in the background would ignore
    until = time.monotonic() + SECONDS_TO_END
    for process in processes:
        try:
            process.wait(max(until - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _outcome(code: int, output: Path, first: int) -> tuple[State, str]:
    """State and reason of an exit status, and of what the command printed from the byte `first` on."""
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
