"""Reading npz archives of plain numbers and strings: nothing is unpickled, and every refusal names its key."""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dln_jax.types import InputError

Data = TypeVar("Data")


def load(path: str | Path, from_arrays: Callable[[dict[str, Any]], Data]) -> Data:
    """Reads all arrays of a file and hands them to `from_arrays`, which checks them.

    Raises:
        InputError: the file is missing, is no npz, holds pickled objects, or `from_arrays` refuses its arrays (the
            message then starts with the path).
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the path of an npz file")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, AttributeError) as error:
        raise InputError(
            f"{path}: not a readable npz file without pickled objects ({type(error).__name__}); "
            "write it with numpy.savez and plain numeric or string arrays"
        ) from error
    try:
        return from_arrays(arrays)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def numeric(
    arrays: dict[str, Any], key: str, shape: tuple[int, ...] | None = None, *, to_match: str = "q"
) -> np.ndarray:
    """The array of that key as float64, which must hold finite real numbers.

    Raises:
        InputError: the key is missing, not numeric, not finite, or of another shape than the one that is to match.
    """
    if key not in arrays:
        raise InputError(f"key '{key}' is missing (found: {', '.join(sorted(arrays)) or 'nothing'}); add it")
    array = np.asarray(arrays[key])
    if array.dtype.kind not in "fiu":
        raise InputError(f"{key} has type {array.dtype}; expected real numbers")
    if shape is not None and array.shape != shape:
        raise InputError(f"{key} has shape {array.shape}; expected {shape} to match {to_match}")
    array = array.astype(np.float64)
    finite = np.isfinite(array)
    if not finite.all():
        first = int(np.argwhere(~finite)[0][0]) if array.ndim else 0
        count = int((~finite).sum())
        raise InputError(
            f"{key} has {count} NaN or infinite value(s), the first at sample {first}; remove or repair them"
        )
    return array
