"""Mesh files: npz with `vertices` [n, dim] in m, `elements` [m, dim + 1] and optionally `held` [k], fixed vertices.

`softbody.mesh.files` reads the formats of meshing programs.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from dln_jax.data.arrays import UNREAD, load_file, unread_line
from dln_jax.softbody.mesh.files import SUFFIXES, read_mesh
from dln_jax.softbody.mesh.mesh import Mesh, make_mesh
from dln_jax.types import InputError, require_positive

KEYS = ("vertices", "elements", "held")


class StoredMesh(NamedTuple):
    """Contents of a mesh file."""

    mesh: Mesh
    held: Int[np.ndarray, " k"] | None
    """Indices of fixed vertices; `None` if the file has none."""
    statements: tuple[str, ...] = ()
    """Notes on parts that were left out or repaired, and keys that were not read; an npz file is never repaired."""


def load(path: str | Path, scale: float = 1.0) -> StoredMesh:
    """Reads and checks a file; never unpickles.

    Args:
        path: path of an npz file, or of a file that `read_mesh` reads.
        scale: length of the file's unit in m, such as 0.001 for millimetres.

    Raises:
        InputError: the file is missing, `read_mesh` refuses it, its arrays do not form a mesh, or `held` is malformed.
    """
    if Path(path).suffix.lower() in SUFFIXES:
        mesh, statements = read_mesh(path, scale=scale)
        return StoredMesh(mesh, None, statements)
    require_positive(scale=scale)
    stored = load_file(path, from_arrays, KEYS)
    return stored._replace(mesh=stored.mesh._replace(vertices=scale * stored.mesh.vertices))


def from_arrays(arrays: dict[str, Any]) -> StoredMesh:
    """Checks the arrays of a mesh file; errors as for `load`."""
    for name in ("vertices", "elements"):
        if name not in arrays:
            keys = ", ".join({*arrays} - {UNREAD}) or "nothing"
            raise InputError(f"'{name}' is missing (found: {keys}); expected `vertices` and `elements`")
    mesh, held = make_mesh(arrays["vertices"], arrays["elements"]), arrays.get("held")
    if held is None:
        return StoredMesh(mesh, None, unread_line(arrays))
    if held.ndim != 1 or held.dtype.kind not in "iu" or held.size == 0:
        raise InputError(
            f"held is {held.dtype} of shape {list(held.shape)}; expected integers [k], k >= 1: indices of vertices"
        )
    return StoredMesh(mesh, held, unread_line(arrays))
