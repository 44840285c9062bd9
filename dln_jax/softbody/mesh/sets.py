"""Named sets of a mesh: held vertices and materials by the names of parts."""

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float, Int

from dln_jax.softbody.mesh.mesh import WORDS, Mesh, NamedSet
from dln_jax.types import InputError


def vertices_in(mesh: Mesh, names: Iterable[str]) -> Int[np.ndarray, " k"]:
    """Returns the vertices that are in any of these sets, in ascending order, for example for `held`.

    Raises:
        InputError: a set does not exist (the message lists those that do), or has no vertices.
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
    """Returns one value per element, such as Young's modulus: that of its set, or the default outside these sets.

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
