"""Files of a run: written whole or not at all, read or refused in one line, and by one writer at a time."""

import itertools
import json
import math
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from filelock import FileLock, Timeout

from dln_jax.types import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CONFIG = "config.json"
"""File in a run's folder that holds the arguments it was started with."""
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
    except FileNotFoundError as error:
        raise InputError(f"{path.parent}: no such folder; create it first") from error
    except OSError as error:
        raise InputError(f"{path}: cannot write there ({error.strerror or error}); choose another place") from error


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file, whole or not at all; errors as `writing`."""
    with writing(path) as partial:
        partial.write_bytes(data)


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Writes JSON, whole or not at all; what is not finite, which JSON cannot say, is null. Errors as `writing`."""
    write_bytes(path, json.dumps(finite(values), indent=2, allow_nan=False).encode() + b"\n")


def write_figure(path: Path, figure: "Figure", **options: Any) -> None:
    """Writes a figure as PNG, whole or not at all; options as `Figure.savefig`, errors as `writing`."""
    with writing(path) as partial:
        figure.savefig(partial, format="png", **options)


def finite(values: Any) -> Any:
    """The same JSON values with `None` for numbers that are not finite."""
    if isinstance(values, Mapping):
        return {key: finite(value) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return [finite(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values


def is_file(path: Path) -> bool:
    """Whether there is a file of this name; a name that the system cannot hold is none."""
    try:
        return path.is_file()
    except OSError:
        return False


def read_json(path: Path, *, remedy: str) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        InputError: the file is missing, cannot be read, or holds anything else; `remedy` says what to do then.
    """
    if not is_file(path):
        raise InputError(f"{path}: no such file; {remedy}")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise InputError(f"{path}: not readable as JSON ({reason}); {remedy}") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: holds a {type(values).__name__}, expected a JSON object; {remedy}")
    return values


def matches(value: Any, hint: Any) -> bool:
    """Whether a JSON value is one of a type: bool, int, float (finite), str, Path (a str), None, Literal or a union."""
    if get_origin(hint) is Literal:
        return any(type(value) is type(each) and value == each for each in get_args(hint))
    if options := get_args(hint):
        return any(matches(value, option) for option in options)
    if isinstance(value, int) and not isinstance(value, bool):
        return hint in (int, float) and abs(value) < 2**63
    if isinstance(value, float):
        return hint is float and math.isfinite(value)
    return isinstance(value, str) if hint is Path else type(value) is (NoneType if hint is None else hint)


@contextmanager
def run_folder(out: Path | None, default: str, *, resume: bool = False) -> Iterator[Path]:
    """Yields the folder of a run, locked: a new one, `out` or the first free number behind `runs/default`.

    What ends in an `InputError` with nothing written but the arguments leaves no folder, so that the same command can
    be given again.

    Args:
        out: the folder, which may exist if it is free.
        default: name of the folder where `out` is `None`.
        resume: the folder is that of an existing run, which is continued.

    Raises:
        InputError: the folder holds something already, cannot be created, or another process is writing there.
        KeyboardInterrupt: with the folder as its argument, so that whoever reports it can say where the run is.
    """
    if resume and out is not None:
        with locked(out), _naming_itself(out):
            yield out
        return
    folder, created = _next_number(Path("runs"), default) if out is None else (out, _create(out))
    _require_free(folder)  # before a lock is put there, and again once nobody else can write
    with locked(folder):
        _require_free(folder)
        try:
            with _naming_itself(folder):
                yield folder
        except InputError:
            _withdraw(folder, created)
            raise


def is_free(folder: Path) -> bool:
    """Whether a folder holds nothing of value: no files but a lock, and what a kill left half-written."""
    return all(entry.name == LOCK or _is_partial(entry) for entry in folder.iterdir())


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
        for left in folder.glob(f"*.{'[0-9a-f]' * 8}{PARTIAL}"):
            with suppress(OSError):
                left.unlink()
        yield
    finally:
        lock.release()


@contextmanager
def _naming_itself(folder: Path) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(folder) from stop


def _is_partial(entry: Path) -> bool:
    return entry.name.endswith(PARTIAL) and not entry.is_dir()


def _next_number(parent: Path, name: str) -> tuple[Path, list[Path]]:
    """Two processes never get one number: creating the folder takes it."""
    created = _create(parent)
    for number in itertools.count(1):
        folder = parent / f"{name}-{number}"
        try:
            folder.mkdir()
            return folder, [folder, *created]
        except FileExistsError:
            continue
        except OSError as error:
            raise InputError(f"{folder}: cannot create the folder ({error.strerror}); choose another --out") from error
    raise AssertionError


def _create(folder: Path) -> list[Path]:
    """Creates a folder with those above it, where they are missing; gives the new ones, the deepest first."""
    try:
        if folder.is_dir():
            return []
        missing = [each for each in (folder, *folder.parents) if not each.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        return missing
    except OSError as error:
        raise InputError(f"{folder}: cannot create the folder ({error.strerror}); choose another --out") from error


def _require_free(folder: Path) -> None:
    try:
        free = is_free(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot read the folder ({error.strerror}); choose another --out") from error
    if not free:
        raise InputError(f"{folder} is not empty; choose another --out, or --resume the run in it")


def _withdraw(folder: Path, created: list[Path]) -> None:
    """Removes what holds nothing of value: the arguments of a run that came to nothing, and the folders made for it."""
    if any(entry.name not in (CONFIG, LOCK) and not _is_partial(entry) for entry in folder.iterdir()):
        return
    with suppress(OSError):
        (folder / CONFIG).unlink(missing_ok=True)
        (folder / LOCK).unlink(missing_ok=True)
        for each in created:
            each.rmdir()


def cache_folder() -> Path:
    """Where what can be made again is kept: `$XDG_CACHE_HOME/dln_jax`, by default `~/.cache/dln_jax`."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "dln_jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot create the folder ({error.strerror}); set XDG_CACHE_HOME") from error
    return folder
