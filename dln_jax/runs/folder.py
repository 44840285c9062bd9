"""The run folder of a command: new or resumed, and locked for one writer, with the arguments of the run in config.json.

A folder is removed if its command fails before writing results. --resume restores the arguments.
"""

import contextlib
import dataclasses
import hashlib
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from jax.experimental import multihost_utils

from dln_jax.errors import InputError
from dln_jax.files import PARTIAL, as_type, is_file, is_folder, read_json, write_json
from dln_jax.options import Scaled
from dln_jax.runs.arguments import arguments_for
from dln_jax.runs.devices import copied_folder

CONFIG = "config.json"
"""File in a run folder with the arguments that the run was started with."""
LOCK = ".lock"
"""Lock file in a run folder; the file stays, and the lock ends with the process that holds it."""
CHOSEN = "chosen"
"""Key in config.json of values derived from the arguments."""
FILES = "files"
"""Key in config.json of the SHA-256 digests of input files, by argument name."""
PLACES = ("out", "resume", "figures", "uncertainty", "devices", "processes", "coordinator", "process_id")
"""Arguments that do not affect the result, such as where it is computed."""
CHANGEABLE = ("seconds",)
"""Arguments that may change with --resume; a class of arguments may list more in its own `CHANGEABLE`."""
REMEDY = "restore the file, or train again into another folder"


def write_config(folder: Path, options: Any, **chosen: Any) -> None:
    """Writes config.json: the arguments of a run, the values `chosen` from them, and digests of the input files."""
    files = {key: fingerprint(path) for key, path in stored_files(options).items()}
    more = {CHOSEN: chosen} if chosen else {}
    write_json(folder / CONFIG, {**stored_arguments(options), **more, **({FILES: files} if files else {})})


def stored_arguments(options: Any) -> dict[str, Any]:
    """The arguments that affect the result, as JSON values."""
    values = dataclasses.asdict(options)
    return {key: str(v) if isinstance(v, Path) else v for key, v in values.items() if key not in PLACES}


def stored_files(options: Any) -> dict[str, Path]:
    """The input files, and folders such as ROS bags, that affect the result, by argument name."""
    values = dataclasses.asdict(options)
    paths = {key: v for key, v in values.items() if isinstance(v, Path) and key not in PLACES}
    return {key: path for key, path in paths.items() if is_file(path) or is_folder(path)}


def fingerprint(path: Path) -> str:
    """SHA-256 digest of a file or folder; a resumed run recognises its data by it, even if they have moved."""
    if is_folder(path):
        inside = sorted((part.relative_to(path).as_posix(), part) for part in path.rglob("*") if is_file(part))
        return hashlib.sha256("\n".join(f"{fingerprint(part)} {name}" for name, part in inside).encode()).hexdigest()
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def with_stored_arguments(typed: Any, arguments: type) -> Any:
    """Restores the arguments of the run in --out; arguments on the command line must not contradict them.

    A file or folder may have moved, if its content is the same.

    Args:
        arguments: dataclass of the command, whose choices in the run decide which options exist.

    Raises:
        InputError: --out holds no run, its arguments or files differ, or its config.json is damaged.
    """
    folder = typed.out
    if folder is None or not is_file(folder / CONFIG):
        raise InputError(f"--resume continues the run in --out, but {folder or '--out'} holds none; name its folder")
    values = read_json(folder / CONFIG, remedy=REMEDY)
    stored = checked_arguments(folder / CONFIG, values, arguments)
    changes, changeable = {}, (*CHANGEABLE, *getattr(arguments, "CHANGEABLE", ()))
    unset, mine = dataclasses.asdict(type(typed)()), dataclasses.asdict(stored)
    digests = values.get(FILES)
    for key, digest in (digests if isinstance(digests, dict) else {}).items():
        moved = stored_files(typed).get(key)
        path, option = moved or Path(str(values.get(key))), f"--{key.replace('_', '-')}"
        if not (is_file(path) or is_folder(path)):
            raise InputError(f"the run in {folder} reads {path}, which does not exist; give its new path with {option}")
        if fingerprint(path) != digest:
            raise InputError(
                f"the data in {path} have changed since the run in {folder} began (SHA-256); give the original file "
                f"with {option}"
            )
        changes[key] = path
    for key, value in dataclasses.asdict(typed).items():
        if value == unset[key] or key in changes:
            continue
        if key in PLACES or key in changeable:
            changes[key] = value
        elif key not in mine or value != mine[key]:
            option = key.replace("_", "-")
            raise InputError(f"the run in {folder} was started with {key} = {mine.get(key)}; leave --{option} out")
    return dataclasses.replace(stored, **changes)


def checked_arguments(path: Path, values: Mapping[str, Any], arguments: type) -> Any:
    """The arguments of a command in a config.json; `InputError` if it is damaged or of another release."""
    values = {key: value for key, value in values.items() if key not in (CHOSEN, FILES)}
    _checked(path, values, arguments)  # the other options depend on the choices
    whole = arguments_for(arguments, values)
    expected = stored_arguments(whole())
    for key, value in values.items():
        # An argument of another release that was left unset does not affect the result.
        if key not in expected and value not in (None, False):
            raise InputError(f"{path}: {key!r:.40} is not an argument of this release; {REMEDY}")
    return _checked(path, values, whole)


def _checked(path: Path, values: Mapping[str, Any], arguments: type) -> Any:
    expected = stored_arguments(arguments())
    if absent := [key for key in expected if key not in values]:
        raise InputError(f"{path}: {absent[0]} is missing; {REMEDY}")
    for key in expected:
        if isinstance(values[key], int) and abs(values[key]) >= 2**63:
            raise InputError(f"{path}: {key} is too large; {REMEDY}")
    return as_type({key: values[key] for key in expected}, arguments, name=str(path), remedy=REMEDY)


@contextlib.contextmanager
def command_folder(options: Any, command: str) -> Iterator[Path]:
    """Yields the run folder of a command. config.json gets the arguments."""
    out, resume = options.out, getattr(options, "resume", False)
    processes, number = (options.processes or 1, options.process_id) if isinstance(options, Scaled) else (1, None)
    folder_of_run = (
        copied_folder(options, resume)
        if number
        else run_folder(out, command, resume=resume, resumable=hasattr(options, "resume"))
    )
    with folder_of_run as folder:
        if resume and processes > 1:
            multihost_utils.sync_global_devices("all are here")
        elif not resume:
            write_config(folder, options)
        yield folder


@contextlib.contextmanager
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
        folder, created = out, None
    else:
        folder, created = _next_number(Path("runs"), default) if out is None else (out, _create(out))
        require_free(folder, resumable)  # before locking, and again below once no other process can write
    with locked(folder):
        if created is not None:
            require_free(folder, resumable)
        try:
            yield folder
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(folder) from stop
        except InputError:
            if created is not None:
                _withdraw(folder, created)
            raise


def holds_only(folder: Path, *names: str) -> bool:
    """Whether a folder has only files with these names, and partial files left by a killed process."""
    every = folder.iterdir()
    return all(path.name in names or (path.name.endswith(PARTIAL) and not path.is_dir()) for path in every)


@contextlib.contextmanager
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
            with contextlib.suppress(OSError):
                left.unlink()
        yield
    finally:
        lock.release()


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


def require_free(folder: Path, resumable: bool) -> None:
    """Raises `InputError` if a folder exists and holds anything but partial files of a killed process.

    Args:
        resumable: whether the calling command could continue a run in the folder.
    """
    try:
        free = not folder.exists() or holds_only(folder, LOCK)
    except OSError as error:
        raise InputError(f"{folder}: cannot read the folder ({error.strerror}); choose another --out") from error
    if not free:
        there, remedy = ("a run", ", or continue it with --resume") if is_file(folder / CONFIG) else ("files", "")
        raise InputError(f"the folder {folder} already contains {there}; choose another --out{remedy * resumable}")


def _withdraw(folder: Path, created: list[Path]) -> None:
    """Removes the arguments of a run without results, and the folders created for it."""
    if not holds_only(folder, CONFIG, LOCK):
        return
    with contextlib.suppress(OSError):
        (folder / CONFIG).unlink(missing_ok=True)
        (folder / LOCK).unlink(missing_ok=True)
        for path in created:
            path.rmdir()
