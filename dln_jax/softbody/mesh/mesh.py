"""Meshes of simplices: triangles in the plane, tetrahedra in space.

Meshes are static NumPy arrays in float64, constants of the compiled simulation. A body in the plane is 1 m thick: its
areas in m² count as volumes in m³. For volumes that are differentiable by the rest shape, see `mesh/simplices.py`.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from dln_jax.softbody.mesh.simplices import connected, facets, regularity, simplex_volumes
from dln_jax.types import InputError

FLAT = 1e-12
"""Elements up to this `regularity` are degenerate: their volume is a rounding error."""
_CORNER_SHARES = {2: 1 / 19, 3: 1 / 36}
"""Share of a quadratic element's mass at one corner (Hinton, Rock and Zienkiewicz 1976): in proportion to the diagonal
of the consistent mass matrix, which is 6 at a corner and 32 in the middle of a side. All shares are positive."""
WORDS = {2: ("triangle", "area"), 3: ("tetrahedron", "volume")}


class NamedSet(NamedTuple):
    """Named part of a body, such as a physical group of Gmsh."""

    vertices: Int[np.ndarray, " k"]
    """In ascending order."""
    elements: Int[np.ndarray, " j"]
    """In ascending order; empty if the set is a surface, a curve or points."""


class Mesh(NamedTuple):
    """Vertices and simplices of a body; `make_mesh` validates them."""

    vertices: Float[np.ndarray, "n dim"]
    """Rest shape in m; dim is 2 or 3."""
    elements: Int[np.ndarray, "m corners"]
    """Corners of the triangles (dim 2) or tetrahedra (dim 3), positively oriented."""
    turned: int = 0
    """Number of inverted elements (clockwise in the plane) reoriented by `make_mesh`."""
    sets: Mapping[str, NamedSet] = MappingProxyType({})
    """Named parts from a mesh file."""
    midsides: Int[np.ndarray, "m edges"] | None = None
    """Mid-side nodes of quadratic elements, in the order of `simplices.SIDES`; `None` for linear elements."""

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.vertices.shape[1]

    @property
    def nodes(self) -> Int[np.ndarray, "m nodes"]:
        """Corners of the elements, followed by their mid-side nodes if they have any."""
        return self.elements if self.midsides is None else np.concatenate([self.elements, self.midsides], axis=1)


def make_mesh(vertices: ArrayLike, elements: ArrayLike) -> Mesh:
    """Builds a mesh of vertices [n, dim] in m and elements [m, dim + 1]; validates it and reorients inverted elements.

    `Mesh.turned` counts the reoriented elements. Elements may overlap: their energies add up; `overlaps` finds them.

    Raises:
        InputError: a position is not finite, a corner is out of range or repeated, an element is a duplicate or
            degenerate, or a vertex belongs to no element; the message names the first one. Also if no two elements
            share a vertex although corners coincide, because the vertices were never merged.
    """
    positions = _as_array("vertices", vertices)
    if positions.dtype.kind not in "iuf":
        raise InputError(f"vertices has type {positions.dtype}; expected real numbers: positions in m")
    if positions.ndim != 2 or positions.shape[1] not in (2, 3):
        raise InputError(f"vertices has shape {list(positions.shape)}; expected [n, 2] (plane) or [n, 3] (space)")
    positions = positions.astype(np.float64)
    if (bad := np.flatnonzero(~np.isfinite(positions).all(axis=1))).size:
        raise InputError(f"vertex {bad[0]} is at {positions[bad[0]].tolist()}; expected finite numbers{_others(bad)}")
    corners, dim = _as_array("elements", elements), positions.shape[1]
    if corners.ndim != 2 or corners.shape[1] != dim + 1 or not corners.shape[0]:
        raise InputError(
            f"elements has shape {list(corners.shape)}; expected [m, {dim + 1}] with m >= 1, "
            f"the corners of each {WORDS[dim][0]}, as vertices has {dim} columns"
        )
    if corners.dtype.kind not in "iu":
        raise InputError(f"elements has type {corners.dtype}; expected integers: the indices of vertices")
    corners = corners.astype(np.int64)
    inverted = _require_elements(positions, corners) < 0
    turned = np.where(inverted[:, None], corners[:, [*range(corners.shape[1] - 2), -1, -2]], corners)
    return Mesh(positions, turned.astype(np.int32), int(inverted.sum()))


def volumes(mesh: Mesh) -> Float[np.ndarray, " m"]:
    """Returns areas in m² or volumes in m³ of the elements."""
    return simplex_volumes(mesh.vertices, mesh.nodes)


def boundary(mesh: Mesh) -> Int[np.ndarray, "f dim"]:
    """Returns the boundary facets, with the body on one side only, oriented outwards.

    An edge [a, b] in the plane has the body on its left and the outward normal (yb - ya, xa - xb). A triangle [a, b, c]
    in space has the outward normal (b - a) x (c - a).
    """
    distinct, counts = _facet_sides(mesh)
    return distinct[(counts == 0).any(axis=1)]


def overlaps(mesh: Mesh) -> Int[np.ndarray, "f dim"]:
    """Returns facets with overlapping elements on one side, where masses and stiffnesses add up.

    Overlaps of elements without a common facet are not detected.
    """
    distinct, counts = _facet_sides(mesh)
    return distinct[(counts > 1).any(axis=1)]


def indices_of(name: str, values: Any, count: int, what: str = "vertex") -> Int[np.ndarray, " k"]:
    """Returns distinct indices below a count, given as integers [k] or as a boolean mask [count].

    Raises:
        InputError: `values` are neither, or an index is out of range or repeated.
    """
    chosen = np.atleast_1d(values)
    if chosen.dtype == bool and chosen.shape == (count,):
        return np.flatnonzero(chosen)
    if chosen.ndim != 1 or (chosen.size and chosen.dtype.kind not in "iu"):
        raise InputError(
            f"{name} is {chosen.dtype} of shape {list(chosen.shape)}; expected integers [k], or booleans [{count}]"
        )
    if len(outside := chosen[(chosen < 0) | (chosen >= count)]):
        raise InputError(f"{name} names {what} {outside[0]}; expected 0..{count - 1}")
    if len(np.unique(chosen)) < len(chosen):
        raise InputError(f"{name} names a {what} twice; expected each once")
    return chosen.astype(int)


def components(mesh: Mesh) -> Int[np.ndarray, " m"]:
    """Returns the component of every element, counted from 0; shared vertices connect elements."""
    return connected(mesh.elements)


def components_of_vertices(mesh: Mesh) -> Int[np.ndarray, " n"]:
    """Returns the component of every vertex."""
    result = np.zeros(len(mesh.vertices), int)
    result[mesh.nodes] = components(mesh)[:, None]
    return result


def vertices_where(mesh: Mesh, condition: Callable[[Float[np.ndarray, "n dim"]], np.ndarray]) -> Int[np.ndarray, " k"]:
    """Returns the vertices with rest positions [n, dim] that satisfy a condition, such as `lambda x: x[:, 0] < 1e-9`.

    Raises:
        InputError: no vertex satisfies it, or the condition does not return one boolean per vertex.
    """
    chosen = np.asarray(condition(mesh.vertices))
    if chosen.shape != (len(mesh.vertices),) or chosen.dtype != bool:
        raise InputError(
            f"the condition gives {chosen.dtype} of shape {list(chosen.shape)}; "
            f"expected bool [{len(mesh.vertices)}], one for each vertex"
        )
    if not chosen.any():
        low, high = mesh.vertices.min(axis=0).tolist(), mesh.vertices.max(axis=0).tolist()
        raise InputError(f"no vertex satisfies the condition; the mesh extends from {low} to {high} m")
    return np.flatnonzero(chosen)


def vertices_in(mesh: Mesh, names: Iterable[str]) -> Int[np.ndarray, " k"]:
    """Returns the vertices in any of these sets, in ascending order, for example for `held`.

    Raises:
        InputError: a set does not exist (the message lists the existing sets), or has no vertices.
    """
    members = [np.zeros(0, np.int64)]
    for name in names:
        if not len(vertices := _named(mesh, name).vertices):
            raise InputError(
                f"no vertex of the body is in the set '{name}' (MSH 2.2 with SaveAll keeps only names; use 4.1)"
            )
        members.append(vertices)
    return np.unique(np.concatenate(members))


def values_by_set(mesh: Mesh, default: float, values: Mapping[str, float]) -> Float[np.ndarray, " m"]:
    """Returns one value per element, such as Young's modulus: the value of its set, or the default.

    An element in several of these sets gets the value of the last one.

    Raises:
        InputError: a set does not exist, or has no elements.
    """
    result = np.full(len(mesh.elements), float(default))
    for name, value in values.items():
        if not len(elements := _named(mesh, name).elements):
            raise InputError(f"the set '{name}' has no elements; expected a set of {WORDS[mesh.dimension][0]} elements")
        result[elements] = value
    return result


def _named(mesh: Mesh, name: str) -> NamedSet:
    if name not in mesh.sets:
        known = f"the sets are {', '.join(sorted(mesh.sets))}" if mesh.sets else "it has no named sets"
        raise InputError(f"the mesh has no set '{name}'; {known}")
    return mesh.sets[name]


def lumped_masses(mesh: Mesh, density: int | float | ArrayLike) -> Float[np.ndarray, " n"]:
    """Returns the masses of the vertices in kg: an element's corners get equal shares of its mass.

    In a quadratic element, each mid-side node gets 16/3 of a corner's share. These masses integrate linear functions
    exactly, so results with body forces converge with order 2 instead of order 3.

    Args:
        mesh: positions in m.
        density: in kg/m³ (in the plane for 1 m of thickness), one for all elements or one per element, [m].

    Raises:
        InputError: a density is not positive and finite, or the number of densities differs from the number of
            elements.
    """
    densities = np.asarray(density, dtype=np.float64)
    m = len(mesh.elements)
    if densities.shape not in ((), (m,)):
        raise InputError(
            f"density has shape {list(densities.shape)}; expected one number or [{m}], one for each element"
        )
    if not (right := (densities > 0) & np.isfinite(densities)).all():
        bad = int(np.argmin(right))
        where = f" of element {bad}" if densities.ndim else ""
        raise InputError(f"density{where} is {densities.flat[bad]}; expected a positive number, in kg/m³")
    corners, nodes = mesh.dimension + 1, mesh.nodes
    share = 1 / corners if mesh.midsides is None else _CORNER_SHARES[mesh.dimension]
    rest = (1 - corners * share) / max(1, nodes.shape[1] - corners)
    shares = np.where(np.arange(nodes.shape[1]) < corners, share, rest)
    weights = (densities * volumes(mesh))[:, None] * shares
    return np.bincount(nodes.reshape(-1), weights=weights.reshape(-1), minlength=len(mesh.vertices))


def _facet_sides(mesh: Mesh) -> tuple[Int[np.ndarray, "f dim"], Int[np.ndarray, "f 2"]]:
    """Returns the distinct facets, oriented as in their first element, and the numbers of elements on their two
    sides."""
    every = facets(mesh.elements).reshape(-1, mesh.dimension)
    _, first, group = np.unique(np.sort(every, axis=1), axis=0, return_index=True, return_inverse=True)
    # The sign of the permutation that sorts a facet's corners gives the side of its element.
    swaps = sum(every[:, i] > every[:, j] for i, j in itertools.combinations(range(mesh.dimension), 2))
    counts = np.bincount(2 * group.reshape(-1) + swaps % 2, minlength=2 * len(first)).reshape(-1, 2)
    order = np.argsort(first)
    return every[first[order]], counts[order]


def _require_elements(vertices: np.ndarray, elements: np.ndarray) -> Float[np.ndarray, " m"]:
    """Returns the elements' `regularity`; refuses invalid elements and dangling vertices."""
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
    shape = regularity(vertices, elements)
    kind, measure = WORDS[vertices.shape[1]]
    if (bad := np.flatnonzero(np.abs(shape) <= FLAT)).size:
        raise InputError(
            f"element {bad[0]} is degenerate: the {measure} of {kind} {elements[bad[0]].tolist()} is "
            f"{shape[bad[0]]:.1e} of a regular {kind}'s; expected more than {FLAT:.0e}; "
            f"leave it out, merge its corners or move one{_others(bad)}"
        )
    uses = np.bincount(elements.ravel(), minlength=n)
    if (bad := np.flatnonzero(uses == 0)).size:
        raise InputError(
            f"vertex {bad[0]} is dangling: it belongs to no element and would have no mass; remove it{_others(bad)}"
        )
    if uses.max() == 1 and (distinct := len(np.unique(vertices, axis=0))) < n:
        raise InputError(
            f"no two of the {len(elements)} elements share a vertex, so each would move alone; "
            f"the {n} vertices have {distinct} distinct positions: merge those at the same position"
        )
    return shape


def _as_array(name: str, value: ArrayLike) -> np.ndarray:
    try:
        return np.asarray(value)
    except ValueError as error:
        raise InputError(f"{name} is not an array: its rows differ in length; expected rows of equal length") from error


def _others(bad: np.ndarray) -> str:
    return f" ({bad.size - 1} more like it)" if bad.size > 1 else ""
