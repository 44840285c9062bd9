"""Writes the files of an export as a unit, and never overwrites a run.

A description, a JSON file beside the others, holds the SHA-256 of each. All new files are complete before the first is
renamed into place, and descriptions come last: after an interruption there are the old files, the new files, or files
that differ from their digests, which `interface.read_interface` refuses. Digests detect accidents, not forgery.
"""

import json
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from dln_jax.files import read_json, writing
from dln_jax.types import InputError


def write_exports(directory: Path, files: Mapping[str, bytes], *, overwrite: bool) -> list[Path]:
    """Writes all files or none, descriptions (.json) last, and creates the folder if it is missing.

    Args:
        directory: folder of the export, not of a run.
        files: name -> bytes, descriptions included.
        overwrite: replace existing files; a .json only if it describes files of the same names.

    Raises:
        InputError: the folder belongs to a run, a file may not be replaced, or the folder cannot be written to.
    """
    if any("tensor_file" in _values(path) for path in directory.glob("*.json")):
        raise InputError(f"{directory} is the folder of a run; export to another, such as {directory / 'exported'}")
    for name, data in files.items():
        path = directory / name
        if path.exists() and not path.is_file():
            raise InputError(f"{path} is not a file and cannot be replaced; choose another folder or name")
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
        # The stack renames in reverse order, so descriptions are entered first.
        for name in sorted(files, key=lambda name: not name.endswith(".json")):
            stack.enter_context(writing(directory / name)).write_bytes(files[name])
    return [directory / name for name in files]


def _values(path: Path) -> dict[str, Any]:
    """Returns the object in a JSON file, or an empty dictionary."""
    with suppress(InputError):
        return read_json(path, remedy="")
    return {}
