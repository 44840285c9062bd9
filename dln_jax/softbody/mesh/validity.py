"""Validation of meshes before a simulation; every message names the first invalid element or vertex.

Meshes without a well-defined motion are refused: a flat element has no strain, a vertex in no element has no mass, and
a duplicate element counts twice. Elements may overlap, and any number may meet at a facet: their energies add up.
"""

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from dln_jax.softbody.mesh.simplices import regularity
from dln_jax.types import InputError

FLAT = 1e-12
"""Largest `regularity` of a degenerate element, whose volume is rounding error."""
WORDS = {2: ("triangle", "area"), 3: ("tetrahedron", "volume")}


def as_vertices(vertices: ArrayLike) -> Float[np.ndarray, "n dim"]:
    """Converts positions to float64 [n, 2] or [n, 3], all finite; raises `InputError` otherwise."""
    array = _as_array("vertices", vertices)
    if array.dtype.kind not in "iuf":
        raise InputError(f"vertices has type {array.dtype}; expected real numbers: positions in m")
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise InputError(f"vertices has shape {list(array.shape)}; expected [n, 2] (plane) or [n, 3] (space)")
    array = array.astype(np.float64)
    if (bad := np.flatnonzero(~np.isfinite(array).all(axis=1))).size:
        raise InputError(f"vertex {bad[0]} is at {array[bad[0]].tolist()}; expected finite numbers{_others(bad)}")
    return array


def as_elements(elements: ArrayLike, dim: int) -> Int[np.ndarray, "m corners"]:
    """Converts corners to int64 [m, dim + 1]; raises `InputError` otherwise."""
    array = _as_array("elements", elements)
    kind = WORDS[dim][0]
    if array.ndim != 2 or array.shape[1] != dim + 1 or not array.shape[0]:
        raise InputError(
            f"elements has shape {list(array.shape)}; expected [m, {dim + 1}] with m >= 1, "
            f"the corners of each {kind}, as vertices has {dim} columns"
        )
    if array.dtype.kind not in "iu":
        raise InputError(f"elements has type {array.dtype}; expected integers: the indices of vertices")
    return array.astype(np.int64)


def require_valid(vertices: Float[np.ndarray, "n dim"], elements: Int[np.ndarray, "m corners"]) -> None:
    """Raises `InputError` unless the elements form a mesh: valid indices, volumes, no duplicate, no dangling vertex."""
    _require_indices(vertices, elements)
    kind, measure = WORDS[vertices.shape[1]]
    shape = regularity(vertices, elements)
    if (bad := np.flatnonzero(np.abs(shape) <= FLAT)).size:
        raise InputError(
            f"element {bad[0]} is degenerate: the {measure} of {kind} {elements[bad[0]].tolist()} is "
            f"{shape[bad[0]]:.1e} of a regular one's; expected more than {FLAT:.0e}; "
            f"leave it out, merge its corners or move one{_others(bad)}"
        )
    uses = np.bincount(elements.ravel(), minlength=len(vertices))
    if (bad := np.flatnonzero(uses == 0)).size:
        raise InputError(
            f"vertex {bad[0]} is dangling: it belongs to no element and would have no mass; remove it{_others(bad)}"
        )
    if uses.max() == 1 and (distinct := len(np.unique(vertices, axis=0))) < len(vertices):
        raise InputError(
            f"no two of the {len(elements)} elements share a vertex, so that each would move alone; "
            f"the {len(vertices)} vertices have {distinct} distinct positions: merge those at the same position"
        )


def oriented(
    vertices: Float[np.ndarray, "n dim"], elements: Int[np.ndarray, "m corners"]
) -> tuple[Int[np.ndarray, "m corners"], int]:
    """Reorients valid elements to positive volume by swapping their last two corners, and counts these elements."""
    inverted = regularity(vertices, elements) < 0
    turned = np.where(inverted[:, None], elements[:, [*range(elements.shape[1] - 2), -1, -2]], elements)
    return turned, int(inverted.sum())


def _require_indices(vertices: np.ndarray, elements: np.ndarray) -> None:
    n = len(vertices)
    if (bad := np.flatnonzero(((elements < 0) | (elements >= n)).any(axis=1))).size:
        corners = elements[bad[0]]
        wrong = corners[(corners < 0) | (corners >= n)][0]
        raise InputError(
            f"element {bad[0]} has corner {wrong}, but there are {n} vertices; expected 0 to {n - 1} "
            f"(indices start at 0){_others(bad)}"
        )
    ordered = np.sort(elements, axis=1)
    same = ordered[:, 1:] == ordered[:, :-1]
    if (bad := np.flatnonzero(same.any(axis=1))).size:
        twice = ordered[bad[0], 1:][same[bad[0]]][0]
        raise InputError(
            f"element {bad[0]} has corner {twice} twice: {elements[bad[0]].tolist()}; "
            f"expected {elements.shape[1]} different vertices{_others(bad)}"
        )
    _, first, inverse = np.unique(ordered, axis=0, return_index=True, return_inverse=True)
    original = first[inverse.reshape(-1)]
    if (bad := np.flatnonzero(original != np.arange(len(elements)))).size:
        raise InputError(f"element {bad[0]} is a duplicate of element {original[bad[0]]}; remove one{_others(bad)}")


def _as_array(name: str, value: ArrayLike) -> np.ndarray:
    try:
        return np.asarray(value)
    except ValueError as error:
        raise InputError(f"{name} is not an array: its rows differ in length; expected rows of equal length") from error


def _others(bad: np.ndarray) -> str:
    return f" ({bad.size - 1} more like it)" if bad.size > 1 else ""
