"""Meshes of simplices: triangles in the plane, tetrahedra in space.

Static NumPy arrays in float64, which become constants of the compiled simulation. A body in the plane is 1 m thick: its
areas in m² count as volumes in m³. `mesh/simplices.py` has volumes that are differentiable by the rest shape.
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
    """Vertices and simplices of a body; `make_mesh` validates them."""

    vertices: Float[np.ndarray, "n dim"]
    """Rest shape in m; dim is 2 or 3."""
    elements: Int[np.ndarray, "m corners"]
    """Corners of the triangles (dim 2) or tetrahedra (dim 3), positively oriented."""
    turned: int = 0
    """Number of inverted elements (clockwise, in the plane) that `make_mesh` has reoriented."""

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.vertices.shape[1]


def make_mesh(vertices: ArrayLike, elements: ArrayLike) -> Mesh:
    """Builds a mesh of vertices [n, dim] in m and elements [m, dim + 1]; validates it and reorients inverted elements.

    `Mesh.turned` counts those. Elements may overlap, because the energies of all add up; `overlaps` returns where.

    Raises:
        InputError: names the first invalid vertex or element: a position that is not finite, a corner out of range or
            repeated, a duplicate or degenerate element, a vertex in no element. Or elements that share no vertex
            although some of their corners coincide: a mesh whose vertices were never merged.
    """
    positions = as_vertices(vertices)
    corners = as_elements(elements, positions.shape[1])
    require_valid(positions, corners)
    corners, turned = oriented(positions, corners)
    return Mesh(positions, corners.astype(np.int32), turned)


def volumes(mesh: Mesh) -> Float[np.ndarray, " m"]:
    """Areas in m² or volumes in m³ of the elements."""
    return simplex_volumes(mesh.vertices, mesh.elements)


def edges(mesh: Mesh) -> Int[np.ndarray, "e 2"]:
    """Distinct edges, with the smaller vertex first, in lexicographic order."""
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
    """Facets with two or more elements on one side. They overlap, with the sum of their masses and stiffnesses.

    Overlaps of elements without a common facet are not detected.
    """
    distinct, counts = _facet_sides(mesh)
    return distinct[(counts > 1).any(axis=1)]


def components(mesh: Mesh) -> Int[np.ndarray, " m"]:
    """Index, from 0, of every element's component; shared vertices connect elements."""
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
        InputError: no vertex does, or the condition does not return one boolean per vertex.
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
    """Masses of the vertices in kg: an element's corners get equal shares of its mass.

    Args:
        mesh: in m.
        density: in kg/m³ (in the plane for 1 m of thickness), one for all elements or one per element, [m].

    Raises:
        InputError: a density is not positive and finite, or their number differs from that of the elements.
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
    """Distinct facets, in the orientation of their first element, and the numbers of elements on their two sides."""
    every = facets(mesh.elements).reshape(-1, mesh.dimension)
    _, first, group = np.unique(np.sort(every, axis=1), axis=0, return_index=True, return_inverse=True)
    # The sign of the permutation that sorts a facet's corners decides on which side its element lies.
    swaps = sum(every[:, i] > every[:, j] for i, j in itertools.combinations(range(mesh.dimension), 2))
    counts = np.bincount(2 * group.reshape(-1) + swaps % 2, minlength=2 * len(first)).reshape(-1, 2)
    order = np.argsort(first)
    return every[first[order]], counts[order]
