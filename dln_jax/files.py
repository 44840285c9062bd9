"""Files: atomic writes, and reads that fail with a one-line error."""

import json
import math
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from dln_jax.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARTIAL = ".partial"
"""Suffix of a file that is being written; a file left behind by a kill can be deleted."""


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """Yields the path of a new file beside `path` to write to; it replaces `path` if the block raises nothing.

    The new file has a unique name and is created exclusively, so it follows no link and does not disturb other writers.

    Raises:
        InputError: the folder is missing or not writable, or the disk is full.
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
    """Writes a file atomically; errors as `writing`."""
    with writing(path) as partial:
        partial.write_bytes(data)


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Writes JSON atomically; infinities and NaN become null. Errors as `writing`."""
    write_bytes(path, json.dumps(finite(values), indent=2, allow_nan=False).encode() + b"\n")


def write_figure(path: Path, figure: "Figure", **options: Any) -> None:
    """Writes a figure as PNG atomically; options as `Figure.savefig`, errors as `writing`."""
    with writing(path) as partial:
        figure.savefig(partial, format="png", **options)


def finite(values: Any) -> Any:
    """Replaces numbers that are not finite in JSON values by `None`."""
    if isinstance(values, Mapping):
        return {key: finite(value) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return [finite(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values


def is_file(path: Path) -> bool:
    """Whether the file exists; False for a name that the system forbids, such as one that is too long."""
    try:
        return path.is_file()
    except OSError:
        return False


def is_folder(path: Path) -> bool:
    """Whether the folder exists; False for a name that the system forbids."""
    try:
        return path.is_dir()
    except OSError:
        return False


def read_json(path: Path, *, remedy: str) -> dict[str, Any]:
    """Reads the JSON object in a file.

    Raises:
        InputError: the file is missing, unreadable, or not a JSON object; the message ends with `remedy`.
    """
    if not is_file(path):
        raise InputError(f"{path}: no such file; {remedy}")
    try:
        values = msgspec.json.decode(path.read_bytes())
    except (ValueError, OSError, RecursionError) as error:
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise InputError(f"{path}: not readable as JSON ({reason}); {remedy}") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: holds a {type(values).__name__}, expected a JSON object; {remedy}")
    return values


def matches(value: Any, kind: Any) -> bool:
    """Whether a JSON value has a type."""
    try:
        as_type(value, kind, name="", remedy="")
    except InputError:
        return False
    if isinstance(value, int):
        return abs(value) < 2**63
    return not isinstance(value, float) or math.isfinite(value)


def as_type(values: Any, kind: Any, *, name: str, remedy: str) -> Any:
    """Converts JSON values to a dataclass, a NamedTuple or any other type; a path is text.

    Raises:
        InputError: a value does not fit the type; the message starts with `name` and ends with `remedy`.
    """
    try:
        return msgspec.convert(values, kind, dec_hook=_decoded)
    except msgspec.ValidationError as error:
        raise InputError(f"{name}: {error}; {remedy}") from None


def _decoded(kind: type, value: Any) -> Any:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise ValueError(f"Expected `{kind.__name__}`, got `{type(value).__name__}`")


def cache_folder() -> Path:
    """Folder for reproducible files, created if missing: `$XDG_CACHE_HOME/dln_jax`, by default `~/.cache/dln_jax`.

    Raises:
        InputError: there is no home folder, or the folder cannot be created.
    """
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:  # from `Path.home`
        raise InputError("this user has no home folder; set XDG_CACHE_HOME to a writable folder") from None
    folder = Path(base) / "dln_jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot create the folder ({error.strerror}); set XDG_CACHE_HOME") from error
    return folder
