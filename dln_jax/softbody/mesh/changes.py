"""Meshes made from others: several bodies in one, bodies moved to their places, and finer or quadratic elements."""

import itertools
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from dln_jax.softbody.mesh.mesh import Mesh, NamedSet, indices_of, make_mesh
from dln_jax.softbody.mesh.simplices import SIDES
from dln_jax.types import InputError


def join(*meshes: Mesh, **bodies: Mesh) -> Mesh:
    """Returns one mesh of several bodies, which share no vertices: `join(floor, left=pad, right=pad)`.

    Named sets are kept, and sets of one name are united. A body given by name becomes a set of that name, for example
    to give it a material of its own (`values_by_set`).

    Raises:
        InputError: there is no mesh, or some are planar and others in space, or linear and quadratic.
    """
    for name, mesh in bodies.items():
        whole = NamedSet(np.arange(len(mesh.vertices)), np.arange(len(mesh.elements)))
        meshes += (mesh._replace(sets={**mesh.sets, name: whole}),)
    if len({(mesh.dimension, mesh.midsides is None) for mesh in meshes}) != 1:
        raise InputError("the meshes differ in dimension or order of their elements, or there is none; join alike ones")
    starts = [0, *itertools.accumulate(len(mesh.vertices) for mesh in meshes)]
    sets: dict[str, NamedSet] = {}
    elements = 0
    for mesh, start in zip(meshes, starts, strict=False):
        for name, (vertices, members) in mesh.sets.items():
            before = sets.get(name, NamedSet(np.zeros(0, int), np.zeros(0, int)))
            sets[name] = NamedSet(
                np.append(before.vertices, vertices + start), np.append(before.elements, members + elements)
            )
        elements += len(mesh.elements)
    nodes = np.concatenate([mesh.nodes + start for mesh, start in zip(meshes, starts, strict=False)])
    corners = meshes[0].dimension + 1
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        nodes[:, :corners],
        sets=sets,
        midsides=None if meshes[0].midsides is None else nodes[:, corners:],
    )


def translate(mesh: Mesh, offset: ArrayLike) -> Mesh:
    """Returns the mesh moved by an offset [dim] in m."""
    return mesh._replace(vertices=mesh.vertices + _vector(mesh, "offset", offset, mesh.dimension))


def rotate(mesh: Mesh, rotation: ArrayLike, *, about: ArrayLike | None = None) -> Mesh:
    """Returns the mesh turned about a point, by default its centre.

    Args:
        mesh: the mesh.
        rotation: an angle in rad, counterclockwise, in the plane; a rotation vector [3] in rad in space.
        about: the point [dim], m.
    """
    size = 1 if mesh.dimension == 2 else 3
    turn = _vector(mesh, "rotation", np.atleast_1d(rotation), size)
    R = Rotation.from_rotvec(turn if size == 3 else [0.0, 0.0, turn[0]]).as_matrix()[: mesh.dimension, : mesh.dimension]
    centre = mesh.vertices.mean(axis=0) if about is None else _vector(mesh, "about", about, mesh.dimension)
    return mesh._replace(vertices=(mesh.vertices - centre) @ R.T + centre)


def _vector(mesh: Mesh, name: str, values: ArrayLike, size: int) -> Float[np.ndarray, " size"]:
    vector = np.asarray(values, float)
    if vector.shape != (size,) or not np.isfinite(vector).all():
        raise InputError(f"{name} is {values}; expected {size} finite number{'s' * (size > 1)} in {mesh.dimension}-D")
    return vector


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
