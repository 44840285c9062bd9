"""What a mesh must be before anything is simulated on it; every message names the first element or vertex at fault."""

import itertools

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from dln_jax.softbody.simplices import facets, regularity
from dln_jax.types import InputError

FLAT = 1e-12
"""An element this flat, as `regularity` measures it, is degenerate: its volume is rounding error."""
WORDS = {2: ("triangle", "area", "edge"), 3: ("tetrahedron", "volume", "triangle")}


def as_vertices(vertices: ArrayLike) -> Float[np.ndarray, "n dim"]:
    """Positions as float64 [n, 2] or [n, 3], all finite; otherwise `InputError`."""
    array = _as_array("vertices", vertices)
    if array.dtype.kind not in "iuf":
        raise InputError(f"vertices has type {array.dtype}; expected real numbers: positions in m")
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise InputError(f"vertices has shape {list(array.shape)}; expected [n, 2] (plane) or [n, 3] (space)")
    array = array.astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        raise InputError(f"vertex {bad[0]} is at {array[bad[0]].tolist()}; expected finite numbers{_others(bad)}")
    return array


def as_elements(elements: ArrayLike, dim: int) -> Int[np.ndarray, "m corners"]:
    """Corners as int64 [m, dim + 1]; otherwise `InputError`."""
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
    """Raises `InputError` unless the elements form a mesh: valid indices, positive volumes, manifold, none dangling."""
    _require_indices(vertices, elements)
    _require_volumes(vertices, elements)
    _require_manifold(elements)
    used = np.zeros(len(vertices), bool)
    used[elements] = True
    bad = np.flatnonzero(~used)
    if bad.size:
        raise InputError(
            f"vertex {bad[0]} is dangling: it belongs to no element and would have no mass; remove it{_others(bad)}"
        )


def _require_indices(vertices: np.ndarray, elements: np.ndarray) -> None:
    n = len(vertices)
    bad = np.flatnonzero(((elements < 0) | (elements >= n)).any(axis=1))
    if bad.size:
        corners = elements[bad[0]]
        wrong = corners[(corners < 0) | (corners >= n)][0]
        raise InputError(
            f"element {bad[0]} has corner {wrong}, but there are {n} vertices; expected 0 to {n - 1} "
            f"(indices start at 0){_others(bad)}"
        )
    ordered = np.sort(elements, axis=1)
    same = ordered[:, 1:] == ordered[:, :-1]
    bad = np.flatnonzero(same.any(axis=1))
    if bad.size:
        twice = ordered[bad[0], 1:][same[bad[0]]][0]
        raise InputError(
            f"element {bad[0]} has corner {twice} twice: {elements[bad[0]].tolist()}; "
            f"expected {elements.shape[1]} different vertices{_others(bad)}"
        )
    _, first, inverse = np.unique(ordered, axis=0, return_index=True, return_inverse=True)
    original = first[inverse.reshape(-1)]
    bad = np.flatnonzero(original != np.arange(len(elements)))
    if bad.size:
        raise InputError(f"element {bad[0]} is a duplicate of element {original[bad[0]]}; remove one{_others(bad)}")


def _require_volumes(vertices: np.ndarray, elements: np.ndarray) -> None:
    kind, measure, _ = WORDS[vertices.shape[1]]
    shape = regularity(vertices, elements)
    bad = np.flatnonzero(np.abs(shape) <= FLAT)
    if bad.size:
        raise InputError(
            f"element {bad[0]} is degenerate: the {measure} of {kind} {elements[bad[0]].tolist()} is "
            f"{shape[bad[0]]:.1e} of a regular one's; expected more than {FLAT:.0e}; "
            f"merge its corners or move one{_others(bad)}"
        )
    bad = np.flatnonzero(shape < 0)
    if bad.size:
        order = "counter-clockwise corners" if kind == "triangle" else "det[x1 - x0, x2 - x0, x3 - x0] > 0"
        raise InputError(
            f"element {bad[0]} is inverted: {kind} {elements[bad[0]].tolist()} has a negative {measure}; "
            f"expected {order}; swap two of its corners{_others(bad)}"
        )


def _require_manifold(elements: np.ndarray) -> None:
    """Each facet belongs to one element, or to two that lie on its two sides."""
    corners = elements.shape[1]
    kind = WORDS[corners - 1][2]
    oriented = facets(elements).reshape(-1, corners - 1)
    owners = np.repeat(np.arange(len(elements)), corners)
    _, group, counts = np.unique(np.sort(oriented, axis=1), axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    bad = np.flatnonzero(counts[group] > 2)
    if bad.size:
        sharing = owners[group == group[bad[0]]].tolist()
        raise InputError(
            f"element {sharing[0]} is not part of a manifold: its {kind} {sorted(oriented[bad[0]].tolist())} "
            f"is shared by elements {sharing}; expected at most 2"
        )
    # Which side a facet's outside is on: the sign of the permutation that sorts its corners.
    swaps = sum(oriented[:, i] > oriented[:, j] for i, j in itertools.combinations(range(corners - 1), 2))
    sided = np.column_stack([group, swaps % 2])
    _, group, counts = np.unique(sided, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    bad = np.flatnonzero(counts[group] > 1)
    if bad.size:
        one, other = owners[group == group[bad[0]]].tolist()
        raise InputError(
            f"element {one} overlaps element {other}: both lie on the same side of their common {kind} "
            f"{sorted(oriented[bad[0]].tolist())}; expected one on either side; correct the corners of one"
        )


def _as_array(name: str, value: ArrayLike) -> np.ndarray:
    try:
        return np.asarray(value)
    except ValueError as error:
        raise InputError(f"{name} is not an array: its rows differ in length; expected rows of equal length") from error


def _others(bad: np.ndarray) -> str:
    return f" ({bad.size - 1} more like it)" if bad.size > 1 else ""
