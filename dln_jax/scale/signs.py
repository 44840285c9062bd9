"""Signs of life: one small file for each process, in a folder that all of them see.

A process writes its own file anew at every beat, and reads those of others. Hosts' clocks are never compared: a file
says something if what it says has changed, and silence is counted in the reader's own time, of which no more than two
beats pass between two looks: a reader that was stopped itself does not take the others for dead.
"""

import contextlib
import json
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

from dln_jax.types import InputError

Stage = Literal["meeting", "met", "joined", "ended", "over"]
"""Looking for the others; all are there; one program; done with the work; process 0: all are done."""


class Limits(NamedTuple):
    """Times, in s."""

    beat: float = 1.0
    """Between two signs."""
    meeting: float = 120.0
    """For all processes to be started, from the first one on."""
    joining: float = 60.0
    """For all to reach process 0's port."""
    silent: float = 30.0
    """Without a sign, after which a process is taken for gone or stuck."""
    grace: float = 3.0
    """For a process to end by itself once another has."""
    idle: float = 3600.0
    """Without progress where progress is reported: a dispatch and its compilation are shorter."""


USUAL = Limits()


class Sign(NamedTuple):
    """What a process says."""

    token: str
    """Of this start of the process."""
    stage: Stage
    host: str
    facts: dict[str, Any]
    """In which processes must agree."""
    beat: int = 0
    code: int = 0
    """Exit status: of its own work, or, of process 0 when it is over, of all."""
    said: str = ""
    """What there is to say about it."""


class Peer(NamedTuple):
    """Another process, as far as it is known."""

    sign: Sign | None = None
    present: bool = False
    """Whether it has been seen to change: what an earlier run has left behind does not."""
    silent: float = 0.0
    """Since its last change, in s."""


def own_sign(facts: dict[str, Any]) -> Sign:
    """The first one of a process."""
    return Sign(secrets.token_hex(8), "meeting", socket.gethostname(), facts)


def write(folder: Path, process: int, sign: Sign) -> None:
    """In place, and not by rename: hosts that share a disk see a file they know change sooner than a new one.

    A disk that is away for a while says nothing for us, and is no error.
    """
    with contextlib.suppress(OSError):
        _file(folder, process).write_text(json.dumps(sign._asdict()))


def read(folder: Path, process: int) -> Sign | None:
    """What a process says; `None` where there is nothing, or half of it."""
    try:
        return Sign(**json.loads(_file(folder, process).read_text()))
    except (OSError, ValueError, TypeError):
        return None


def has_left(folder: Path, process: int) -> bool:
    """Whether a process has removed what it said; a file that is being written is there."""
    return not _file(folder, process).exists()


def looked_at(peer: Peer, folder: Path, process: int, seconds: float) -> Peer:
    """What is known of a process after another look, `seconds` after the last."""
    sign = read(folder, process)
    if sign is None or sign == peer.sign:
        return peer._replace(silent=peer.silent + seconds)
    return Peer(sign, present=peer.sign is not None, silent=0.0)


def require_own(folder: Path, process: int, token: str) -> None:
    """Raises `InputError` if another process writes this one's file."""
    sign = read(folder, process)
    if sign is not None and sign.token != token:
        raise InputError(f"--process-id {process} is given twice: another process on {sign.host} has it")


def remove(folder: Path, process: int) -> None:
    """Removes what a process has said."""
    with contextlib.suppress(OSError):
        _file(folder, process).unlink()


@contextlib.contextmanager
def sign_folder(folder: Path, process: int, token: str) -> Iterator[None]:
    """Makes the folder; removes this process's file in the end, and the folder where it was the last one.

    Raises:
        InputError: it cannot be made.
    """
    missing = [each for each in (folder, *folder.parents) if not each.exists()] or [folder]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot create the folder ({error.strerror}); choose another --out") from error
    try:
        yield
    finally:
        last = read(folder, process)
        if last is None or last.token == token:
            remove(folder, process)
        with contextlib.suppress(OSError):
            for each in missing:
                each.rmdir()


def _file(folder: Path, process: int) -> Path:
    return folder / f"{process}.json"
