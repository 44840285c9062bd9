"""Quadratic meshes: mid-side nodes on the edges of a linear mesh, and the split that avoids locking."""

from types import MappingProxyType

import numpy as np
from jaxtyping import Int
from numpy.typing import ArrayLike

from dln_jax.softbody.mesh.mesh import Mesh, NamedSet, indices_of, make_mesh
from dln_jax.softbody.mesh.simplices import SIDES
from dln_jax.types import InputError


def quadratic(mesh: Mesh) -> Mesh:
    """Adds a node in the middle of every edge: triangles of 6 nodes and tetrahedra of 10.

    The new vertices follow those of the mesh, whose corners keep their indices; named sets are extended by
    `with_midsides`. Edges are straight; for a curved rest shape, move vertices by `mesh._replace(vertices=...)`. With
    curved edges, uniform strains are exact in the plane but not in space: move only mid-side nodes on the boundary.

    Raises:
        InputError: the mesh is already quadratic.
    """
    if mesh.midsides is not None:
        raise InputError("the mesh is quadratic already; pass the linear mesh")
    pairs = np.sort(mesh.elements[:, np.array(SIDES[mesh.dimension])], axis=2)
    sides, number = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    midsides = len(mesh.vertices) + number.reshape(pairs.shape[:2])
    vertices = np.concatenate([mesh.vertices, mesh.vertices[sides].mean(axis=1)])
    body = mesh._replace(vertices=vertices, midsides=midsides.astype(np.int32))
    sets = {name: part._replace(vertices=with_midsides(body, part.vertices)) for name, part in mesh.sets.items()}
    return body._replace(sets=MappingProxyType(sets))


def barycentric_split(mesh: Mesh) -> Mesh:
    """Splits each element of a linear mesh at its centre into 3 triangles or 4 tetrahedra (Alfeld split).

    In the plane, quadratic elements on a split mesh are the Scott-Vogelius pair of degree 2: it satisfies the inf-sup
    condition (Arnold and Qin 1992) and converges with order 3 even as nu approaches 1/2. In space this is proved only
    from degree 3 on (Zhang 2005).

    Raises:
        InputError: the mesh is quadratic.
    """
    if mesh.midsides is not None:
        raise InputError("the mesh is quadratic; split the linear mesh, then pass it to quadratic")
    centres = len(mesh.vertices) + np.arange(len(mesh.elements))
    corners = np.arange(mesh.dimension + 1)
    parts = [np.where(corners == i, centres[:, None], mesh.elements) for i in corners]
    vertices = np.concatenate([mesh.vertices, mesh.vertices[mesh.elements].mean(axis=1)])
    count = len(mesh.elements)
    sets = {
        name: NamedSet(
            np.concatenate([part.vertices, centres[part.elements]]),
            np.concatenate([i * count + part.elements for i in corners]),
        )
        for name, part in mesh.sets.items()
    }
    split = make_mesh(vertices, np.concatenate(parts))
    return split._replace(turned=mesh.turned, sets=MappingProxyType(sets))


def with_midsides(mesh: Mesh, vertices: ArrayLike) -> Int[np.ndarray, " k"]:
    """Returns corners of a quadratic mesh together with the mid-side nodes between any two of them, for `held`."""
    vertices = indices_of("held", vertices, len(mesh.vertices))
    chosen = np.isin(mesh.elements, vertices)[:, np.array(SIDES[mesh.dimension])].all(axis=2)
    return np.union1d(vertices, mesh.nodes[:, mesh.dimension + 1 :][chosen]).astype(int)
