"""Quadratic meshes: mid-side nodes on the edges of a linear mesh."""

import numpy as np
from jaxtyping import Int
from numpy.typing import ArrayLike

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import SIDES
from dln_jax.types import InputError


def quadratic(mesh: Mesh) -> Mesh:
    """Adds a node in the middle of every edge: triangles of 6 nodes and tetrahedra of 10.

    The new vertices follow those of the mesh, whose corners and their numbers stay. Edges are straight; for a curved
    rest shape, move vertices by `mesh._replace(vertices=...)`, in space on the boundary only: with curved edges inside, a
    uniform strain is exact in the plane but not in space, where the quadrature is not exact for them.

    Raises:
        InputError: the mesh is quadratic already.
    """
    if mesh.midsides is not None:
        raise InputError("the mesh is quadratic already; pass the linear mesh")
    pairs = np.sort(mesh.elements[:, np.array(SIDES[mesh.dimension])], axis=2)
    sides, number = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    midsides = len(mesh.vertices) + number.reshape(pairs.shape[:2])
    vertices = np.concatenate([mesh.vertices, mesh.vertices[sides].mean(axis=1)])
    return mesh._replace(vertices=vertices, midsides=midsides.astype(np.int32))


def with_midsides(mesh: Mesh, vertices: ArrayLike) -> Int[np.ndarray, " k"]:
    """Returns some corners of a quadratic mesh together with the mid-side nodes between any two of them, for `held`."""
    chosen = np.isin(mesh.elements, vertices)[:, np.array(SIDES[mesh.dimension])].all(axis=2)
    return np.union1d(vertices, mesh.nodes[:, mesh.dimension + 1 :][chosen]).astype(int)
