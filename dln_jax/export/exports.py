"""Files of an export: written together, never over a run's, and read only while they belong together.

A description, JSON beside what it describes, holds the SHA-256 of each file and its own. Every new file is complete
before the first takes its place, and descriptions come last: whatever ends the renaming leaves old or new files, or a
description whose digests do not fit, which readers refuse. Digests find accidents, and do not say who wrote a file.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from dln_jax.files import read_json, writing
from dln_jax.types import InputError

AGAIN = "export it again"


def described(facts: Mapping[str, Any], files: Mapping[str, bytes]) -> bytes:
    """The description of files (bytes by name): facts, JSON values, and the digests."""
    values = {**facts, "files": {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}}
    return json.dumps({**values, "sha256": _digest(values)}, indent=2).encode() + b"\n"


def write_exports(directory: Path, files: Mapping[str, bytes], *, overwrite: bool) -> list[Path]:
    """Writes files by name, all or none, descriptions (.json) last; creates the folder where it is missing.

    Args:
        directory: of an export, and of no run.
        files: what is to be written, descriptions of it included.
        overwrite: replace files that exist, but a .json only where it describes files of these names.

    Raises:
        InputError: the folder is a run's, a file is there that may not be replaced, or nothing can be written there.
    """
    if any("tensor_file" in _values(path) for path in directory.glob("*.json")):
        raise InputError(f"{directory} is the folder of a run; export to another, such as {directory / 'exported'}")
    for name, data in files.items():
        path = directory / name
        if path.exists() and not path.is_file():
            raise InputError(f"{path} is no file and cannot be replaced; choose another folder or name")
        if path.exists() and name.endswith(".json"):
            there, ours = _values(path).get("files"), json.loads(data)["files"]
            if not isinstance(there, dict) or there.keys() != ours.keys():
                raise InputError(f"{path} describes no export of this name; choose another folder or name")
    existing = [name for name in files if (directory / name).exists()]
    if existing and not overwrite:
        raise InputError(f"{directory} holds {', '.join(existing)} already; choose another folder or overwrite them")
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{directory}: cannot write there ({error.strerror}); choose another folder") from error
    with ExitStack() as stack:
        # What is entered last is renamed first.
        for name in sorted(files, key=lambda name: not name.endswith(".json")):
            stack.enter_context(writing(directory / name)).write_bytes(files[name])
    return [directory / name for name in files]


def read_export(path: Path, names: Iterable[str]) -> tuple[dict[str, Any], dict[str, bytes]]:
    """What a description says, its digests apart, and the bytes of the files of these names beside it.

    Raises:
        InputError: one is missing, cannot be read, or is not as it was written.
    """
    values = read_json(path, remedy=f"{AGAIN}, and keep its files together")
    stated, digests = values.pop("sha256", None), values.get("files")
    if stated is None or not isinstance(digests, dict):
        raise InputError(f"{path}: describes no export, or one of an older release; {AGAIN}")
    if stated != _digest(values):
        raise InputError(f"{path}: truncated or altered (its SHA-256 is not the one in it); {AGAIN}")
    del values["files"]
    files = {}
    for name in names:
        file = path.with_name(name)
        try:
            files[name] = file.read_bytes()
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror}); {AGAIN}") from error
        if hashlib.sha256(files[name]).hexdigest() != digests.get(name):
            raise InputError(f"{file}: truncated or altered (its SHA-256 is not {path.name}'s); {AGAIN}")
    return values, files


def _values(path: Path) -> dict[str, Any]:
    """What is in a JSON file, nothing if that is no object."""
    with suppress(InputError):
        return read_json(path, remedy="")
    return {}


def _digest(values: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
