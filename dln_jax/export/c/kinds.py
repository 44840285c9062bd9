"""The number types of a program, and their names in C and in NumPy."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from dln_jax.types import InputError

C_TYPES: Mapping[str, str] = {
    "real": "real",
    "bool": "int",
    "int": "int32_t",
    "long": "int64_t",
    "unsigned": "uint32_t",
    "unsigned_long": "uint64_t",
    "index": "long long",
}
"""C type of each kind. An `index` counts array elements; only the program computes it, so it cannot overflow."""
NUMPY_TYPES: Mapping[str, Any] = {
    "bool": np.bool_,
    "int": np.int32,
    "long": np.int64,
    "unsigned": np.uint32,
    "unsigned_long": np.uint64,
    "index": np.int64,
}
"""NumPy type of each kind but `real`, which has the precision of the export."""
SIGNED = ("int", "long")
"""Integer kinds whose overflow C leaves undefined."""
UNSIGNED = ("unsigned", "unsigned_long")
_KINDS = {"float32": "real", "float64": "real", "bool": "bool", "int32": "int"}
# JAX gives tangents of integers this type; no program computes with them.
_KINDS |= {str(jax.dtypes.float0): "bool"}
_KINDS |= {"int64": "long", "uint32": "unsigned", "uint64": "unsigned_long"}


def kind_of(dtype: Any) -> str:
    """Returns the kind of a JAX dtype, and raises InputError if C has none."""
    if str(dtype) not in _KINDS:
        hint = "random numbers are drawn outside" if str(dtype).startswith("key<") else "cast it to 32 or 64 bits"
        raise InputError(f"an array has type {dtype}, which generated C does not have; {hint}")
    return _KINDS[str(dtype)]
