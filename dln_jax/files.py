"""Files of a run: written whole or not at all, read or refused in one line, and by one writer at a time."""

import json
import math
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from dln_jax.types import InputError

PARTIAL = ".partial"
"""Ending of a file that is being written; one that was left behind by a kill holds nothing of value."""
LOCK = ".lock"
"""File in a run's folder by which it is locked; it stays, and the lock ends with the process that holds it."""


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """Yields the path of a new file beside `path`, to be written; it takes the place of `path` if nothing is raised.

    The file is created exclusively under a name of its own: no link is followed, and no other writer is disturbed.

    Raises:
        InputError: the folder is missing or cannot be written to, or the disk is full.
    """
    partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}{PARTIAL}")
    try:
        partial.open("xb").close()
        try:
            yield partial
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot write there ({error.strerror or error}); choose another place") from error


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file, whole or not at all; errors as `writing`."""
    with writing(path) as partial:
        partial.write_bytes(data)


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Writes JSON, whole or not at all; what is not finite, which JSON cannot say, is null. Errors as `writing`."""
    write_bytes(path, json.dumps(finite(values), indent=2, allow_nan=False).encode() + b"\n")


def finite(values: Any) -> Any:
    """The same JSON values with `None` for numbers that are not finite."""
    if isinstance(values, Mapping):
        return {key: finite(value) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return [finite(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values


def read_json(path: Path, *, remedy: str) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        InputError: the file is missing, cannot be read, or holds anything else; `remedy` says what to do then.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; {remedy}")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise InputError(f"{path}: not readable as JSON ({reason}); {remedy}") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: holds a {type(values).__name__}, expected a JSON object; {remedy}")
    return values


def is_free(folder: Path) -> bool:
    """Whether a folder holds nothing of value: no files but a lock, and what a kill left half-written."""
    return all(entry.name == LOCK or entry.name.endswith(PARTIAL) for entry in folder.iterdir())


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Holds the lock of an existing folder, which also ends with the process, and removes what a kill left behind.

    Raises:
        InputError: another process holds it.
    """
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise InputError(f"{folder}: another process is writing there; wait for it, or choose another --out") from None
    except OSError as error:
        raise InputError(f"{folder}: cannot write there ({error.strerror}); choose another --out") from error
    try:
        for left in folder.glob(f"*{PARTIAL}"):
            left.unlink(missing_ok=True)
        yield
    finally:
        lock.release()
