"""Folders of runs: a new one or an existing one, one writer at a time, and nothing left of what came to nothing."""

import itertools
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from dln_jax.files import PARTIAL, is_file
from dln_jax.types import InputError

CONFIG = "config.json"
"""File in a run's folder that holds the arguments it was started with."""
LOCK = ".lock"
"""File in a run's folder by which it is locked; it stays, and the lock ends with the process that holds it."""


@contextmanager
def run_folder(out: Path | None, default: str, *, resume: bool = False, resumable: bool = False) -> Iterator[Path]:
    """Yields the folder of a run, locked: a new one, `out` or the first free number behind `runs/default`.

    What ends in an `InputError` with nothing written but the arguments leaves no folder, so that the same command can
    be given again.

    Args:
        out: the folder, which may exist if it is free.
        default: name of the folder where `out` is `None`.
        resume: the folder is that of an existing run, which is continued.
        resumable: whether the command that asks could continue a run in the folder.

    Raises:
        InputError: the folder holds something already, cannot be created, or another process is writing there.
        KeyboardInterrupt: with the folder as its argument, so that whoever reports it can say where the run is.
    """
    if resume and out is not None:
        with locked(out), _naming_itself(out):
            yield out
        return
    folder, created = _next_number(Path("runs"), default) if out is None else (out, _create(out))
    _require_free(folder, resumable)  # before a lock is put there, and again once nobody else can write
    with locked(folder):
        _require_free(folder, resumable)
        try:
            with _naming_itself(folder):
                yield folder
        except InputError:
            _withdraw(folder, created)
            raise


def holds_only(folder: Path, *names: str) -> bool:
    """Whether a folder has nothing but files of these names, and what a kill left half-written."""
    every = folder.iterdir()
    return all(each.name in names or (each.name.endswith(PARTIAL) and not each.is_dir()) for each in every)


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


def _require_free(folder: Path, resumable: bool) -> None:
    try:
        free = holds_only(folder, LOCK)
    except OSError as error:
        raise InputError(f"{folder}: cannot read the folder ({error.strerror}); choose another --out") from error
    if not free:
        there, remedy = ("a run", ", or continue it with --resume") if is_file(folder / CONFIG) else ("files", "")
        raise InputError(f"the folder {folder} already contains {there}; choose another --out{remedy * resumable}")


def _withdraw(folder: Path, created: list[Path]) -> None:
    """Removes what holds nothing of value: the arguments of a run that came to nothing, and the folders made for it."""
    if not holds_only(folder, CONFIG, LOCK):
        return
    with suppress(OSError):
        (folder / CONFIG).unlink(missing_ok=True)
        (folder / LOCK).unlink(missing_ok=True)
        for each in created:
            each.rmdir()
