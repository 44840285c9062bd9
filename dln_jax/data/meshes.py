"""Mesh files: npz with `vertices` [n, dim] in m, `elements` [m, dim + 1] and optionally `held` [k], fixed vertices.

`softbody.mesh.files` reads the formats of meshing programs.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from dln_jax.data.arrays import UNREAD, load_file, unread_line
from dln_jax.softbody.mesh.files import SUFFIXES, read_mesh
from dln_jax.softbody.mesh.mesh import Mesh, make_mesh
from dln_jax.types import InputError, require_positive

KEYS = ("vertices", "elements", "held")
Stored = tuple[Mesh, Int[np.ndarray, " k"] | None, tuple[str, ...]]
"""A mesh, the indices of its fixed vertices (`None` without any), and notes on skipped or repaired contents."""


def load(path: str | Path, scale: float = 1.0) -> Stored:
    """Reads and checks a file; never unpickles. An npz file is never repaired.

    Args:
        path: an npz file, or a file that `read_mesh` reads.
        scale: unit of length of the file in m, such as 0.001 for millimetres.

    Raises:
        InputError: the file is missing, `read_mesh` refuses it, its arrays do not form a mesh, or `held` is malformed.
    """
    if Path(path).suffix.lower() in SUFFIXES:
        mesh, statements = read_mesh(path, scale=scale)
        return mesh, None, statements
    require_positive(scale=scale)
    mesh, held, statements = load_file(path, from_arrays, KEYS)
    return mesh._replace(vertices=scale * mesh.vertices), held, statements


def from_arrays(arrays: dict[str, Any]) -> Stored:
    """Checks the arrays of a mesh file; errors as for `load`."""
    for name in ("vertices", "elements"):
        if name not in arrays:
            keys = ", ".join({*arrays} - {UNREAD}) or "nothing"
            raise InputError(f"'{name}' is missing (found: {keys}); expected `vertices` and `elements`")
    mesh, held = make_mesh(arrays["vertices"], arrays["elements"]), arrays.get("held")
    if held is not None and (held.ndim != 1 or held.dtype.kind not in "iu" or held.size == 0):
        raise InputError(
            f"held is {held.dtype} of shape {list(held.shape)}; expected integers [k], k >= 1: indices of vertices"
        )
    return mesh, held, unread_line(arrays)
