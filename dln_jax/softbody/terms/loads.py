"""Dead loads on vertices, facets and volume: forces that do not turn with the body.

    V = -sum over vertices of f·x,    f = F,    f = t ∫ N dA over facets,    f = b ∫ N dV over elements

with the shape functions N of the rest shape, a force F in N, a traction t in N per m² of the rest shape (per m of an
edge in the plane, 1 m thick) and a body force b in N/m³. For a pressure, which follows the surface, see `pressure`.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import facet_rule, simplex_volumes
from dln_jax.softbody.mesh.surfaces import checked_facets, facet_nodes, facet_points
from dln_jax.softbody.terms.term import (
    Context,
    Corners,
    Indices,
    Numbers,
    Term,
    control_of,
    require_dimension,
    vertex_list,
)
from dln_jax.types import InputError, Scalar

_NODES = {2: (0.0, 1 / 3), 3: (-1 / 20, 1 / 5)}
"""Shares of a quadratic element's volume at a corner and at a mid-side node: integrals of the shape functions."""


class Load(NamedTuple):
    """Parameters of a load."""

    force: Float[Array, "*m dim"] | None
    """Load in N, N/m² or N/m³, or `None` if it is the control."""


def point_force(mesh: Mesh, vertices: Indices, force: Numbers | None = None, *, name: str = "force") -> Term:
    """A force in N on each of these vertices, one [dim] or one per vertex [m, dim]; by default the control of the step.

    Raises:
        InputError: the vertices or the force do not fit the mesh.
    """
    indices = vertex_list("vertices with a force", vertices)
    return _load(name, mesh, indices[:, 0], force, lambda _: jnp.ones(len(indices)), per_vertex=True)


def traction(mesh: Mesh, facets: ArrayLike, force: Numbers | None = None, *, name: str = "traction") -> Term:
    """A force [dim] per rest area on facets, such as `facets_in(mesh, name)`; by default the control of the step.

    Raises:
        InputError: the facets or the force do not fit the mesh.
    """
    nodes = facet_nodes(mesh, checked_facets(mesh, facets))
    values, _, _ = facet_rule(mesh.dimension, mesh.midsides is not None)
    vertices, local = np.unique(nodes, return_inverse=True)

    def areas(rest: Array) -> Array:
        _, normals = facet_points(rest[nodes])
        return _summed(len(vertices), local, jnp.linalg.norm(normals, axis=2) @ values)

    return _load(name, mesh, vertices, force, areas)


def body_force(mesh: Mesh, force: Numbers | None = None, *, name: str = "body_force") -> Term:
    """A force [dim] per rest volume on all elements, in N/m³; by default the control of the step."""
    corner, middle = (1 / (mesh.dimension + 1), 0.0) if mesh.midsides is None else _NODES[mesh.dimension]
    shares = np.where(np.arange(mesh.nodes.shape[1]) <= mesh.dimension, corner, middle)

    def volumes(rest: Array) -> Array:
        return _summed(len(mesh.vertices), mesh.nodes, simplex_volumes(rest, mesh.nodes)[:, None] * shares)

    return _load(name, mesh, np.arange(len(mesh.vertices)), force, volumes)


def _load(
    name: str,
    mesh: Mesh,
    vertices: Int[np.ndarray, " m"],
    force: Numbers | None,
    weights: Callable[[Array], Array],
    *,
    per_vertex: bool = False,
) -> Term:
    """Builds the term of forces on vertices: weights, a function of the rest shape, times the parameter."""
    count, dimension = len(vertices), mesh.dimension
    if force is not None:
        force = jnp.asarray(force, dtype=float)
        if force.shape != (dimension,) and not (per_vertex and force.shape == (count, dimension)):
            more = f", or [{count}, {dimension}]: one for each vertex" if per_vertex else ""
            raise InputError(f"the force of '{name}' has shape {list(force.shape)}; expected [{dimension}]{more}")
        if not isinstance(force, Tracer) and not np.isfinite(force).all():
            raise InputError(f"the force of '{name}' is not finite; expected numbers")

    def prepare(parameters: Load, context: Context) -> Float[Array, "m dim"]:
        force = parameters.force
        if force is None:
            force = control_of(name, context, (dimension,), "the components of the force")
        require_dimension(f"the force of '{name}'", force.shape[-1], context.rest.shape[1])
        return weights(context.rest)[:, None] * force

    def energy(x: Corners, force: Float[Array, " dim"]) -> Scalar:
        return -jnp.asarray(sum(force[i] * coordinate for i, coordinate in enumerate(x[0])))

    control = (dimension,) if force is None else None
    return Term(name, vertices[:, None], energy, Load(force), prepare, control=control, mesh=mesh)


def _summed(count: int, nodes: Int[np.ndarray, "m nodes"], shares: Float[Array, "m nodes"]) -> Float[Array, " count"]:
    return jnp.zeros(count, shares.dtype).at[nodes.reshape(shares.shape)].add(shares)
