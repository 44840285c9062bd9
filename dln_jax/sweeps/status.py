"""What is known of a job: one small file in its folder, written by the job itself, and by the sweep if it could not."""

import re
import reprlib
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_type_hints

from dln_jax.files import in_words, is_file, matches, read_json, write_json
from dln_jax.types import InputError

STATUS = "status.json"
OUTPUT = "output.txt"
"""What the command printed, errors too."""

RUN = re.compile(r"run(-\d{1,9})?")
"""Names of the folders that a job gives to its runs."""
State = Literal["missing", "running", "done", "failed", "killed"]


class Status(NamedTuple):
    """Of one job."""

    state: State = "missing"
    line: str = ""
    """Why, if it is not done: the command's own line, or the engine's word."""
    attempt: int = 0
    run: str = ""
    """Folder of the run, in the job's."""
    seconds: float | None = None
    """From start to end of the last attempt."""
    host: str = ""
    process: int | None = None
    """Its number there."""


def status_of(folder: Path) -> Status:
    """The status in a job's folder; a job whose run is gone is missing again.

    Raises:
        InputError: the file is damaged, or names a run that is not in the job's folder.
    """
    path, remedy = folder / STATUS, "remove it, and --resume does the job again"
    if not is_file(path):
        return Status()
    stored: dict[str, Any] = read_json(path, remedy=remedy)
    for name, hint in get_type_hints(Status).items():
        if name in stored and not matches(stored[name], hint):
            raise InputError(f"{path}: {name} is {reprlib.repr(stored[name])}; expected {in_words(hint)}; {remedy}")
    status = Status(**{name: stored[name] for name in Status._fields if name in stored})
    if status.attempt < 0 or (status.run and not RUN.fullmatch(status.run)) or (folder / status.run).is_symlink():
        raise InputError(f"{path}: attempt {status.attempt}, run '{status.run:.60}' are not those of a job; {remedy}")
    if status.state == "done" and not (status.run and any((folder / status.run).glob("*"))):
        return Status(line="its run is gone", attempt=status.attempt)
    return status


def write_status(folder: Path, status: Status) -> None:
    """Writes it whole or not at all."""
    write_json(folder / STATUS, status._asdict())


def renew(folder: Path) -> None:
    """Takes back that a job has failed or was killed, since it is started again; what it has begun is kept."""
    status = status_of(folder)
    if status.state in ("failed", "killed"):
        write_status(folder, status._replace(state="missing", line=""))


def close(folder: Path, word: str) -> Status:
    """The status of a job whose engine says that it is over: one that still runs by its own word was killed.

    Args:
        folder: of the job.
        word: of the engine, for example OUT_OF_MEMORY; may be empty.
    """
    begun = status_of(folder).state != "missing"
    how = "ended without a word" if begun else "did not start"
    return end(folder, f"{how} ({word})" if word else how)


def end(folder: Path, line: str) -> Status:
    """The status of a job that is over; if it does not say so itself, it was killed, and `line` is why."""
    status = status_of(folder)
    if status.state in ("missing", "running"):
        status = status._replace(state="killed", line=line)
        write_status(folder, status)
    return status
