"""Several bodies in one mesh, and bodies moved to their places before the simulation."""

import itertools

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from dln_jax.softbody.mesh.mesh import Mesh, NamedSet
from dln_jax.types import InputError


def join(*meshes: Mesh, **bodies: Mesh) -> Mesh:
    """Returns one mesh of several bodies, which share no vertices: `join(floor, left=pad, right=pad)`.

    Named sets are kept, and sets of one name are united. A body given by name becomes a set of that name, for example
    to give it a material of its own (`sets.values_by_set`).

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
