"""Run folders: new or resumed, locked for one writer, and removed if a command fails before writing results."""

import itertools
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from dln_jax.files import PARTIAL, is_file
from dln_jax.types import InputError

CONFIG = "config.json"
"""File in a run folder with the arguments that the run was started with."""
LOCK = ".lock"
"""Lock file in a run folder; the file stays, and the lock ends with the process that holds it."""


@contextmanager
def run_folder(out: Path | None, default: str, *, resume: bool = False, resumable: bool = False) -> Iterator[Path]:
    """Yields the locked folder of a run: `out`, or the first free number after `runs/default`.

    After an `InputError`, a folder that holds only the arguments is removed, so that the command can be repeated.

    Args:
        out: the folder, which may exist if it is free.
        default: name of the folder if `out` is `None`.
        resume: continue the existing run in the folder.
        resumable: whether the calling command could continue a run in the folder.

    Raises:
        InputError: the folder is not empty, cannot be created, or another process is writing there.
        KeyboardInterrupt: with the folder as its argument, so that the handler can report where the run is.
    """
    if resume and out is not None:
        with locked(out), _naming_itself(out):
            yield out
        return
    folder, created = _next_number(Path("runs"), default) if out is None else (out, _create(out))
    _require_free(folder, resumable)  # before locking, and again below once no other process can write
    with locked(folder):
        _require_free(folder, resumable)
        try:
            with _naming_itself(folder):
                yield folder
        except InputError:
            _withdraw(folder, created)
            raise


def holds_only(folder: Path, *names: str) -> bool:
    """Whether a folder has only files with these names, and partial files left by a killed process."""
    every = folder.iterdir()
    return all(path.name in names or (path.name.endswith(PARTIAL) and not path.is_dir()) for path in every)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Locks an existing folder until the block or the process ends, and removes partial files of a killed process.

    Raises:
        InputError: another process holds the lock.
    """
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise InputError(f"{folder}: another process is writing there; wait for it, or choose another --out") from None
    except (OSError, NotImplementedError) as error:  # the second by older filelocks without flock
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{folder}: cannot write there ({reason}); choose another --out") from error
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


def _next_number(parent: Path, name: str) -> tuple[Path, list[Path]]:
    """Creates the folder with the next free number; its creation reserves the number against other processes."""
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
    """Creates a folder and its missing parents; returns the new folders, the deepest first."""
    try:
        if folder.is_dir():
            return []
        missing = [parent for parent in (folder, *folder.parents) if not parent.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        return missing
    except OSError as error:
        raise InputError(f"{folder}: cannot create the folder ({error.strerror}); choose another --out") from error


def _require_free(folder: Path, resumable: bool) -> None:
    try:
        free = holds_only(folder, LOCK)
    except OSError as error:
        raise InputError(f"{folder}: cannot read the folder ({error.strerror}); choose another --out") from error
    if not free:
        there, remedy = ("a run", ", or continue it with --resume") if is_file(folder / CONFIG) else ("files", "")
        raise InputError(f"the folder {folder} already contains {there}; choose another --out{remedy * resumable}")


def _withdraw(folder: Path, created: list[Path]) -> None:
    """Removes the arguments of a run without results, and the folders created for it."""
    if not holds_only(folder, CONFIG, LOCK):
        return
    with suppress(OSError):
        (folder / CONFIG).unlink(missing_ok=True)
        (folder / LOCK).unlink(missing_ok=True)
        for path in created:
            path.rmdir()
