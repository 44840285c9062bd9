"""Reads npz archives of plain numbers and strings without unpickling, and checks the magnitudes of their numbers.

Only the arrays requested are read. Each must match the sizes stated in the archive and in its header, and together they
may hold at most `MOST_BYTES`. Markers of missing values, such as 1e308, and unsuitable units are refused: scales and
losses would be infinite or zero although every single number is finite.
"""

import math
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.errors import LARGEST, SMALLEST
from dln_jax.files import is_file, is_folder
from dln_jax.types import InputError

Data = TypeVar("Data")
Reader = Callable[[Path], dict[str, Any]]
"""Reader of a file or folder: returns arrays by key, and under `UNREAD` the names that it skips."""

MOST_BYTES = 4 * 2**30
"""Limit on all arrays of one file, since a small archive may expand a thousandfold."""
UNREAD = "unread"
"""Key for the names that a reader skips, such as column titles."""
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
"""Header readers for the versions of NumPy's format that hold numbers and strings."""
MOST_TIMES_TYPICAL = 1e20
"""A number larger than the median by this factor cannot be a measurement: float64 has 16 digits."""
MARKERS = "remove the samples if they mark missing values"


def load_file(
    path: str | Path,
    from_arrays: Callable[[dict[str, Any]], Data],
    keys: Sequence[str],
    *,
    reader: Reader | None = None,
) -> Data:
    """Reads the arrays with these keys, if present, and passes them to `from_arrays`, which checks them.

    The names of all other contents are passed under `UNREAD`, for a remark.

    Args:
        from_arrays: converts arrays by key into the result.
        reader: reads a file of another format or a folder; by default npz.

    Raises:
        InputError: the file is missing, is not an npz, is damaged, holds pickled objects or more than `MOST_BYTES`, or
            `from_arrays` or the reader rejects its contents (the message then starts with the path).
    """
    path = Path(path)
    if not is_file(path) and not (reader is not None and is_folder(path)):
        raise InputError(f"{path!s:.200}: no such file; give the path of the data")
    arrays = {}
    try:
        arrays = _read(path, keys) if reader is None else reader(path)
        return from_arrays(arrays)
    except InputError as error:
        names = "".join(f" ({line})" for line in unread_line(arrays))
        raise InputError(f"{path}: {error}{names}") from None


def unread_line(arrays: Mapping[str, Any]) -> tuple[str, ...]:
    """Returns a remark with the names of skipped contents; empty if nothing was skipped."""
    names = ", ".join(arrays.get(UNREAD, ()))
    return (f"not read: {names if len(names) <= 200 else f'{names[:200]}...'}",) if names else ()


def _read(path: Path, keys: Sequence[str]) -> dict[str, Any]:
    """Reads the arrays with these keys from an npz file, and the names of all others."""
    arrays: dict[str, Any] = {}
    room, key = MOST_BYTES, None
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
            for key in (key for key in keys if f"{key}.npy" in archive.namelist()):
                member = archive.getinfo(f"{key}.npy")
                with archive.open(member) as file:
                    arrays[key] = _array(file, member.file_size, room)
                room -= arrays[key].nbytes
    except InputError as error:
        raise InputError(f"{key} {error}") from None
    except Exception as error:  # zipfile, its decoders and NumPy's header parser raise many types
        where = "" if key is None else f" in '{key}'"
        raise InputError(
            f"not a readable npz file without pickled objects ({type(error).__name__}{where}); "
            "write it with numpy.savez and plain numeric or string arrays"
        ) from error
    return {**arrays, UNREAD: [name for name in names if name not in keys]}


def _array(file: Any, size: int, room: int) -> np.ndarray:
    """Reads one array from an archive entry of `size` bytes; `InputError` for more than `room` bytes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about headers that Python 2 wrote
        shape, by_columns, dtype = HEADERS[np.lib.format.read_magic(file)](file)
    expected = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or dtype.names or not dtype.itemsize or min(shape, default=0) < 0:
        raise InputError(f"has type {str(dtype)[:60]}; expected plain numbers or strings, without pickled objects")
    if expected != size - file.tell():
        raise InputError(f"has {size - file.tell()} bytes for shape {str(shape)[:60]} of {dtype}; write the file again")
    if expected > room:
        raise InputError(
            f"has shape {str(shape)[:60]}, which makes the file larger than {MOST_BYTES >> 30} GiB; split the data"
        )
    data = file.read(expected)
    if len(data) != expected or file.read(1):
        raise InputError(f"ends after {len(data)} of {expected} bytes; write the file again")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if by_columns else "C")


def numeric(
    arrays: dict[str, Any],
    key: str,
    shape: tuple[int, ...] | None = None,
    *,
    to_match: str = "q",
    most: float = LARGEST,
) -> np.ndarray:
    """Returns the array with this key as float64, checked for finite real numbers.

    Raises:
        InputError: the key is missing, not numeric, not finite, has the wrong shape, or its largest number is so large
            or small that squares overflow or vanish.
    """
    if key not in arrays:
        raise InputError(
            f"key '{key}' is missing (found: {', '.join(sorted({*arrays} - {UNREAD})) or 'nothing'}); add it"
        )
    try:
        array = np.asarray(arrays[key])
    except ValueError as error:
        raise InputError(f"{key} is ragged; expected one array of real numbers") from error
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
    largest = float(np.abs(array).max(initial=0.0))
    if largest != 0 and not SMALLEST <= largest <= most:
        squares = "overflow" if largest > most else "vanish"
        raise InputError(
            f"{key} has numbers of up to {largest:.1e}, whose squares {squares}; {MARKERS}, else give it in SI units"
        )
    return array


def on_device(name: str, array: np.ndarray, dtype: Any) -> Array:
    """Converts an array of samples to a dtype on the device; `InputError` if the sum of its squares overflows."""
    _require_squares(name, array, dtype)
    return jnp.asarray(array, dtype)


def spread(name: str, array: Float[np.ndarray, "N k"]) -> Float[np.ndarray, " k"]:
    """Returns the standard deviation of each column, in float64.

    Raises:
        InputError: squares overflow, nonzero squares all vanish, or numbers exceed `MOST_TIMES_TYPICAL` medians.
    """
    _require_squares(name, array, np.float64)
    sizes = np.abs(array[array != 0])
    largest = float(sizes.max(initial=0.0))
    if sizes.size and largest > MOST_TIMES_TYPICAL * (typical := float(np.median(sizes))):
        raise InputError(f"{name} has numbers of up to {largest:.1e} where half are below {typical:.1e}; {MARKERS}")
    if 0 < largest < np.sqrt(np.finfo(np.float64).tiny):
        raise InputError(f"{name} has numbers of at most {largest:.1e}, whose squares vanish; give it in smaller units")
    return array.std(axis=0)


def _require_squares(name: str, array: np.ndarray, dtype: Any) -> None:
    largest = float(np.abs(array).max(initial=0.0))
    if not largest < np.sqrt(float(np.finfo(dtype).max) / max(array.size, 1)):
        raise InputError(
            f"{name} has numbers of up to {largest:.1e}, whose squares overflow in {np.dtype(dtype).name}; {MARKERS}, "
            "else give it in larger units"
        )
