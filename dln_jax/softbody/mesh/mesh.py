"""Meshes of simplices: triangles in the plane, tetrahedra in space.

Static NumPy arrays in float64: what a simulation compiles in. A body in the plane is 1 m thick: its areas in m² count
as volumes in m³. `mesh/simplices.py` has the volumes for a rest shape that one differentiates by.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dln_jax.softbody.mesh.simplices import facets, simplex_volumes
from dln_jax.softbody.mesh.validity import as_elements, as_vertices, oriented, require_valid
from dln_jax.types import InputError


class Mesh(NamedTuple):
    """Vertices and the simplices they span; `make_mesh` checks them."""

    vertices: Float[np.ndarray, "n dim"]
    """Rest shape in m; dim is 2 or 3."""
    elements: Int[np.ndarray, "m corners"]
    """Corners of each triangle (dim 2) or tetrahedron (dim 3), positively oriented."""
    turned: int = 0
    """How many of the elements given to `make_mesh` were inverted (clockwise, in the plane) and have been turned."""

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.vertices.shape[1]


def make_mesh(vertices: ArrayLike, elements: ArrayLike) -> Mesh:
    """A mesh of vertices [n, dim] in m and elements [m, dim + 1], checked and its inverted elements turned.

    `Mesh.turned` counts those. Elements may overlap, as the energies of all add up; `overlaps` says where.

    Raises:
        InputError: names the first vertex or element at fault: a position that is not finite, a corner out of range or
            repeated, an element that is duplicate or degenerate, a vertex in no element. Or elements that share no
            vertex although some of their corners coincide: a mesh whose vertices were never merged.
    """
    positions = as_vertices(vertices)
    corners = as_elements(elements, positions.shape[1])
    require_valid(positions, corners)
    corners, turned = oriented(positions, corners)
    return Mesh(positions, corners.astype(np.int32), turned)


def volumes(mesh: Mesh) -> Float[np.ndarray, " m"]:
    """Area in m² or volume in m³ of each element."""
    return simplex_volumes(mesh.vertices, mesh.elements)


def edges(mesh: Mesh) -> Int[np.ndarray, "e 2"]:
    """Each edge once, its smaller vertex first, in lexicographic order."""
    pairs = list(itertools.combinations(range(mesh.dimension + 1), 2))
    return np.unique(np.sort(mesh.elements[:, pairs].reshape(-1, 2), axis=1), axis=0)


def boundary(mesh: Mesh) -> Int[np.ndarray, "f dim"]:
    """Facets with the body on one side only, oriented outwards.

    An edge [a, b] of the plane has the body on its left: its outward normal is (yb - ya, xa - xb). That of a triangle
    [a, b, c] in space is (b - a) x (c - a).
    """
    distinct, counts = _facet_sides(mesh)
    return distinct[(counts == 0).any(axis=1)]


def overlaps(mesh: Mesh) -> Int[np.ndarray, "f dim"]:
    """Facets with two elements or more on one side, which overlap: what they share has the mass and stiffness of all.

    Overlaps of elements without a common facet are not found.
    """
    distinct, counts = _facet_sides(mesh)
    return distinct[(counts > 1).any(axis=1)]


def components(mesh: Mesh) -> Int[np.ndarray, " m"]:
    """Number, from 0, of the component that each element belongs to; shared vertices connect elements."""
    n, m = len(mesh.vertices), len(mesh.elements)
    corners = mesh.elements.ravel()
    first = np.repeat(mesh.elements[:, 0], mesh.elements.shape[1])
    _, of_vertices = connected_components(coo_array((np.ones(len(corners)), (first, corners)), shape=(n, n)))
    return np.unique(of_vertices[mesh.elements[:, 0]], return_inverse=True)[1].reshape(m)


def boundary_vertices(mesh: Mesh) -> Int[np.ndarray, " b"]:
    """Vertices of the boundary, in ascending order."""
    return np.unique(boundary(mesh))


def vertices_where(mesh: Mesh, condition: Callable[[Float[np.ndarray, "n dim"]], np.ndarray]) -> Int[np.ndarray, " k"]:
    """Indices of the vertices whose rest positions [n, dim] satisfy a condition, such as `lambda x: x[:, 0] < 1e-9`.

    Raises:
        InputError: no vertex does, or the condition does not give one boolean per vertex.
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


def lumped_masses(mesh: Mesh, density: int | float | ArrayLike) -> Float[np.ndarray, " n"]:
    """Mass of each vertex in kg: every element gives each of its corners an equal share.

    Args:
        mesh: in m.
        density: in kg/m³ (in the plane for 1 m of thickness), one for all elements or one for each, [m].

    Raises:
        InputError: a density is not positive and finite, or there are not as many as elements.
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
    shares = densities * volumes(mesh) / (mesh.dimension + 1)
    weights = np.repeat(shares, mesh.dimension + 1)
    return np.bincount(mesh.elements.reshape(-1), weights=weights, minlength=len(mesh.vertices))


def _facet_sides(mesh: Mesh) -> tuple[Int[np.ndarray, "f dim"], Int[np.ndarray, "f 2"]]:
    """Distinct facets, as their first element has them, and how many elements lie on either side of each."""
    every = facets(mesh.elements).reshape(-1, mesh.dimension)
    _, first, group = np.unique(np.sort(every, axis=1), axis=0, return_index=True, return_inverse=True)
    # On which side an element lies is the sign of the permutation that sorts its facet's corners.
    swaps = sum(every[:, i] > every[:, j] for i, j in itertools.combinations(range(mesh.dimension), 2))
    counts = np.bincount(2 * group.reshape(-1) + swaps % 2, minlength=2 * len(first)).reshape(-1, 2)
    order = np.argsort(first)
    return every[first[order]], counts[order]
