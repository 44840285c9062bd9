"""The run folder of a command, with its arguments: stored in config.json and restored by --resume."""

import contextlib
import dataclasses
import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dln_jax.errors import InputError
from dln_jax.files import as_type, is_file, is_folder, read_json, write_json
from dln_jax.runs.arguments import arguments_for
from dln_jax.runs.scaled import copied_folder, is_first, wait_for_all
from dln_jax.zoo.run_folder import CONFIG, run_folder

CHOSEN = "chosen"
"""Key in config.json of values derived from the arguments."""
FILES = "files"
"""Key in config.json of the SHA-256 digests of input files, by argument name."""
SCALE = ("devices", "processes", "coordinator", "process_id")
"""Arguments that state where a result is computed."""
PLACES = ("out", "resume", "figures", "uncertainty", *SCALE)
"""Arguments that do not affect the result."""
CHANGEABLE = ("seconds",)
"""Arguments that may change with --resume; a class of arguments may list more in its own `CHANGEABLE`."""
REMEDY = "restore the file, or train again into another folder"


def write_config(folder: Path, options: Any, **chosen: Any) -> None:
    """Writes config.json: the arguments of a run, the values `chosen` from them, and digests of the input files."""
    files = fingerprints(stored_files(options))
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


def fingerprints(files: Mapping[str, Path]) -> dict[str, str]:
    """SHA-256 digests of files and folders; a resumed run recognises its data by them, even if they have moved."""

    def of_file(path: Path) -> str:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def of_folder(path: Path) -> str:
        inside = sorted((part.relative_to(path).as_posix(), part) for part in path.rglob("*") if is_file(part))
        return hashlib.sha256("\n".join(f"{of_file(part)} {name}" for name, part in inside).encode()).hexdigest()

    return {name: of_folder(path) if is_folder(path) else of_file(path) for name, path in files.items()}


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
            raise InputError(f"the run in {folder} reads {path}, which is not here; give its new path by {option}")
        if fingerprints({key: path})[key] != digest:
            raise InputError(
                f"the run in {folder} was started with other data than {path} has now (SHA-256); give the file it was "
                f"started with by {option}"
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
def command_folder(options: Any, command: str, **chosen: Any) -> Iterator[Path]:
    """Yields the run folder of a command. config.json gets the arguments, and the values `chosen` from them."""
    resume = getattr(options, "resume", False)
    folder_of_run = (
        run_folder(options.out, command, resume=resume, resumable=hasattr(options, "resume"))
        if is_first(options)
        else copied_folder(options, resume)
    )
    with folder_of_run as folder:
        if resume:
            wait_for_all(options)
        else:
            write_config(folder, options, **chosen)
        yield folder
