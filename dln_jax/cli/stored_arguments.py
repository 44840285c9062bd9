"""Arguments of a run: stored in its folder and restored by --resume."""

import dataclasses
import hashlib
import reprlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast, get_args, get_type_hints

from dln_jax.files import in_words, is_file, matches, read_json, write_json
from dln_jax.types import InputError
from dln_jax.zoo.run_folder import CONFIG

CHOSEN = "chosen"
"""Key in config.json of values derived from the arguments."""
FILES = "files"
"""Key in config.json of the SHA-256 digests of input files, by argument name."""
SCALE = ("devices", "processes", "coordinator", "process_id")
"""Arguments that state where a result is computed."""
PLACES = ("out", "resume", "figures", "low_latency", "uncertainty", *SCALE)
"""Arguments that do not affect the result."""
CHANGEABLE = ("seconds",)
"""Arguments that may change with --resume; a class of arguments may list more in its own `CHANGEABLE`."""

Arguments = TypeVar("Arguments")


def write_config(folder: Path, given: Any, **chosen: Any) -> None:
    """Writes config.json: the arguments of a run, the values `chosen` from them, and digests of the input files."""
    files = fingerprints(stored_files(given))
    more = {CHOSEN: chosen} if chosen else {}
    write_json(folder / CONFIG, {**stored_arguments(given), **more, **({FILES: files} if files else {})})


def stored_arguments(given: Any) -> dict[str, Any]:
    """The arguments that affect the result, as JSON values."""
    values = dataclasses.asdict(given)
    return {key: str(v) if isinstance(v, Path) else v for key, v in values.items() if key not in PLACES}


def stored_files(given: Any) -> dict[str, Path]:
    """The input files that affect the result, by argument name."""
    values = dataclasses.asdict(given)
    return {key: v for key, v in values.items() if isinstance(v, Path) and key not in PLACES and is_file(v)}


def fingerprints(files: Mapping[str, Path]) -> dict[str, str]:
    """SHA-256 digests of files; a resumed run recognises its files by them, even if they have moved."""
    found = {}
    for name, path in files.items():
        with path.open("rb") as file:
            found[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


def with_stored_arguments(given: Arguments) -> Arguments:
    """Restores the arguments of the run in --out; arguments on the command line must not contradict them.

    A file may have moved, if its content is the same.

    Raises:
        InputError: --out holds no run, its arguments or files differ, or its config.json is damaged.
    """
    folder = getattr(given, "out")  # noqa: B009  every script's arguments have it
    if folder is None or not is_file(folder / CONFIG):
        raise InputError(f"--resume continues the run in --out, but {folder or '--out'} holds none; name its folder")
    unset = stored_arguments(type(given)())
    stored = checked_arguments(folder / CONFIG, type(given), unset)
    changeable = (*CHANGEABLE, *getattr(type(given), "CHANGEABLE", ()))
    known = read_json(folder / CONFIG, remedy="restore it").get(FILES)
    known = known if isinstance(known, dict) else {}
    anew = stored_files(given)
    for key, digest in known.items():
        path = anew.get(key, Path(str(stored.get(key))))
        option = f"--{key.replace('_', '-')}"
        if not is_file(path):
            raise InputError(f"the run in {folder} reads {path}, which is not here; give its new path by {option}")
        if fingerprints({key: path})[key] != digest:
            raise InputError(
                f"the run in {folder} was started with other data than {path} has now (SHA-256); give the file it was "
                f"started with by {option}"
            )
        stored[key] = str(path)
    for key, value in stored_arguments(given).items():
        if key not in changeable and value not in (stored[key], unset[key]):
            option = key.replace("_", "-")
            raise InputError(f"the run in {folder} was started with {key} = {stored[key]}; leave --{option} out")
    hints = get_type_hints(type(given))
    stored |= {key: getattr(given, key) for key in changeable if getattr(given, key, None) is not None}
    for key, value in stored.items():
        if isinstance(value, str) and Path in (hints[key], *get_args(hints[key])):
            stored[key] = Path(value)
    return dataclasses.replace(cast(Any, given), **stored)


def checked_arguments(path: Path, arguments: type, expected: Collection[str]) -> dict[str, Any]:
    """Reads the arguments in a config.json and checks their types against the command's dataclass.

    Raises:
        InputError: the file is damaged, or a release with other arguments wrote it.
    """
    remedy = "restore the file, or train again into another folder"
    stored = read_json(path, remedy=remedy)
    for each in (CHOSEN, FILES):
        stored.pop(each, None)
    if absent := [key for key in expected if key not in stored]:
        raise InputError(f"{path}: {absent[0]} is missing; {remedy}")
    hints = get_type_hints(arguments)
    # An argument of another release that was left unset does not affect the result.
    stored = {key: value for key, value in stored.items() if key in expected or value not in (None, False)}
    for key, value in stored.items():
        if key not in expected:
            raise InputError(f"{path}: {key!r:.40} is no argument of this release; {remedy}")
        if not matches(value, hints[key]):
            raise InputError(f"{path}: {key} is {reprlib.repr(value)}; expected {in_words(hints[key])}; {remedy}")
    return stored
