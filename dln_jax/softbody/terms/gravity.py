"""Gravity as an energy term."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.terms.term import Context, Corners, Numbers, Term, require_dimension, vector
from dln_jax.types import InputError, Scalar, require_positive


class Gravity(NamedTuple):
    """Parameters of gravity."""

    acceleration: Float[Array, " dim"]
    """In m/s²."""


def gravity(vertices: Mesh | int, acceleration: Numbers | None = None, *, name: str = "gravity") -> Term:
    """-m g·x for all vertices of a mesh, or for the first `vertices` of them; g is the acceleration in m/s².

    With a mesh, g defaults to 9.81 m/s² against the last axis, which points up: y in the plane, z in space.
    """
    count = vertices if isinstance(vertices, int) else len(vertices.vertices)
    require_positive(vertices=count)
    if acceleration is None:
        if isinstance(vertices, int):
            raise InputError("gravity got a number of vertices and no acceleration; pass its 2 or 3 components")
        acceleration = (*(0.0,) * (vertices.dimension - 1), -9.81)
    parameters = Gravity(vector("acceleration", acceleration))

    def prepare(parameters: Gravity, context: Context) -> Float[Array, "n dim"]:
        require_dimension("the acceleration of gravity", parameters.acceleration.shape[0], context.rest.shape[1])
        return context.masses[:count, None] * parameters.acceleration

    def energy(x: Corners, weight: Float[Array, " dim"]) -> Scalar:
        return -jnp.asarray(sum(weight[i] * coordinate for i, coordinate in enumerate(x[0])))

    mesh = None if isinstance(vertices, int) else vertices
    return Term(name, np.arange(count)[:, None], energy, parameters, prepare, mesh=mesh)
