"""The contact surface of a body: its vertices, edges and triangles, and the areas that they represent.

The facets of a quadratic mesh are divided at their mid-side nodes, into 2 edges in the plane and 4 triangles in space,
so all nodes are in contact, on a surface that is linear between them.
"""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dln_jax.softbody.mesh.mesh import Mesh, boundary
from dln_jax.softbody.mesh.surfaces import facet_nodes

_PARTS = {3: ((0, 2), (2, 1)), 6: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))}
"""Parts of a quadratic facet by its number of nodes, with the facet's orientation."""


class Surface(NamedTuple):
    """Primitives of the boundary, as vertex indices. A body in the plane has no triangles."""

    vertices: Int[np.ndarray, " v"]
    edges: Int[np.ndarray, "e 2"]
    triangles: Int[np.ndarray, "f 3"]

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return 3 if len(self.triangles) else 2


def surface_of(mesh: Mesh) -> Surface:
    """Returns the boundary of a mesh."""
    facets = boundary(mesh)
    if mesh.midsides is not None:
        nodes = facet_nodes(mesh, facets)
        facets = nodes[:, np.array(_PARTS[nodes.shape[1]])].reshape(-1, mesh.dimension)
    if mesh.dimension == 2:
        return Surface(np.unique(facets), np.sort(facets, axis=1), np.zeros((0, 3), int))
    pairs = facets[:, list(itertools.combinations(range(3), 2))].reshape(-1, 2)
    return Surface(np.unique(facets), np.unique(np.sort(pairs, axis=1), axis=0), facets)


def areas(surface: Surface, rest: Float[Array, "n dim"]) -> tuple[Float[Array, " v"], Float[Array, " e"]]:
    """Returns the areas of vertices and edges in m²: each gets a third of the areas of its triangles.

    In the plane, for a thickness of 1 m, a vertex gets half the lengths of its edges and an edge its length.
    """
    if surface.dimension == 2:
        lengths = jnp.linalg.norm(rest[surface.edges[:, 1]] - rest[surface.edges[:, 0]], axis=1)
        return _shared(surface.vertices[:, None], surface.edges, lengths / 2), lengths
    a, b, c = (rest[corner] for corner in surface.triangles.T)
    thirds = jnp.linalg.norm(jnp.cross(b - a, c - a), axis=1) / 6
    return (
        _shared(surface.vertices[:, None], surface.triangles, thirds),
        _shared(surface.edges, surface.triangles, thirds),
    )


def _shared(primitives: np.ndarray, facets: np.ndarray, share: Float[Array, " facets"]) -> Float[Array, " primitives"]:
    """Adds up, for every primitive, the shares of the facets that contain it."""
    k = primitives.shape[1]
    parts = np.sort(facets[:, list(itertools.combinations(range(facets.shape[1]), k))], axis=2)
    _, number = np.unique(np.concatenate([primitives, parts.reshape(-1, k)]), axis=0, return_inverse=True)
    order = np.zeros(len(primitives), int)
    order[number.reshape(-1)[: len(primitives)]] = np.arange(len(primitives))
    owners = order[number.reshape(-1)[len(primitives) :]]
    return jnp.zeros(len(primitives), share.dtype).at[owners].add(jnp.repeat(share, parts.shape[1]))
