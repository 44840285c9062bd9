"""Loads: gravity, dead loads on vertices, facets and volume, and pressure in chambers.

Gravity and dead loads do not turn with the body:

    V = -sum over vertices of f·x,    f = m g,    f = F,    f = t ∫ N dA over facets,    f = b ∫ N dV over elements

with the acceleration g in m/s², the shape functions N of the rest shape, a force F in N, a traction t in N per m² of
the rest shape (per m of an edge in the plane, 1 m thick) and a body force b in N/m³. Pressure follows the surface:

    pressure:  -p V(x)                                         force on every facet:  p times its area, along its normal
    gas:       -n R T ln(V(x)/V0) + p_a (V(x) - V0)             p = n R T / V - p_a

with the volume V inside a closed surface of facets (`mesh.surfaces`), in m³, or m² for 1 m of thickness. A gauge
pressure is a sum over facets. A gas couples all vertices of its chamber, because its pressure falls as the chamber
grows: it is one element with a dense Hessian.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import determinant, facet_rule, simplex_volumes
from dln_jax.softbody.mesh.surfaces import checked_facets, closed_surface, enclosed_volume, facet_nodes, facet_points
from dln_jax.softbody.terms.term import (
    Bound,
    Context,
    Corners,
    Indices,
    Numbers,
    Term,
    material,
    require_dimension,
    value_or_control,
    vector,
    vertex_rows,
)
from dln_jax.types import InputError, Scalar, require_positive

_NODES = {2: (0.0, 1 / 3), 3: (-1 / 20, 1 / 5)}
"""Shares of a quadratic element's volume at a corner and at a mid-side node: integrals of the shape functions."""
MOST_VERTICES = 800
"""Largest chamber of a sealed gas: its dense Hessian has (vertices times dimension)² entries, stored twice."""
ATMOSPHERE = 101325.0
"""Standard ambient pressure, in Pa."""
FINITE = Bound(np.isfinite, "a finite number")


class Gravity(NamedTuple):
    """Parameters of gravity."""

    acceleration: Float[Array, " dim"]
    """In m/s²."""


class Load(NamedTuple):
    """Parameters of a load."""

    force: Float[Array, "*m dim"] | None
    """Load in N, N/m² or N/m³; `None` if the control sets it."""


class Pressure(NamedTuple):
    """Parameters of a gauge pressure."""

    pressure: Float[Array, ""] | None
    """Gauge pressure p in Pa; `None` if the control sets it."""


class Gas(NamedTuple):
    """Parameters of a sealed gas."""

    amount: Float[Array, ""] | None
    """n R T in J; `None` if the control sets it."""
    ambient: Float[Array, ""]
    """Ambient pressure p_a in Pa."""


def gravity(mesh: Mesh, acceleration: Numbers | None = None, *, name: str = "gravity") -> Term:
    """-m g·x for all vertices of a mesh; g is the acceleration in m/s².

    Default: 9.81 m/s² against the last axis, which points up (y in the plane, z in space).
    """
    down = (*(0.0,) * (mesh.dimension - 1), -9.81)
    parameters = Gravity(vector("acceleration", down if acceleration is None else acceleration))

    def prepare(parameters: Gravity, context: Context) -> Float[Array, "n dim"]:
        require_dimension("the acceleration of gravity", parameters.acceleration.shape[0], mesh.dimension)
        return context.masses[:, None] * parameters.acceleration

    return Term(name, np.arange(len(mesh.vertices))[:, None], _dead, parameters, prepare, mesh=mesh)


def point_force(mesh: Mesh, vertices: Indices, force: Numbers | None = None, *, name: str = "force") -> Term:
    """A force in N on each of these vertices, one [dim] or one per vertex [m, dim]; by default the control of the step.

    Raises:
        InputError: the vertices or the force do not fit the mesh.
    """
    indices = vertex_rows("vertices with a force", vertices, 1)
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
            raise InputError(f"the force of '{name}' is not finite; expected finite numbers")

    def prepare(parameters: Load, context: Context) -> Float[Array, "m dim"]:
        force = value_or_control(parameters.force, name, context, (dimension,), "the components of the force")
        require_dimension(f"the force of '{name}'", force.shape[-1], context.rest.shape[1])
        return weights(context.rest)[:, None] * force

    control = (dimension,) if force is None else None
    return Term(name, vertices[:, None], _dead, Load(force), prepare, control=control, mesh=mesh)


def _dead(x: Corners, force: Float[Array, " dim"]) -> Scalar:
    """Returns the energy of a vertex under a constant force."""
    return -jnp.asarray(sum(force[i] * coordinate for i, coordinate in enumerate(x[0])))


def _summed(count: int, nodes: Int[np.ndarray, "m nodes"], shares: Float[Array, "m nodes"]) -> Float[Array, " count"]:
    return jnp.zeros(count, shares.dtype).at[nodes.reshape(shares.shape)].add(shares)


def pressure(
    mesh: Mesh, facets: ArrayLike, *, pressure: float | None = None, cap: bool = False, name: str = "pressure"
) -> Term:
    """Gauge pressure in Pa in a chamber with these facets, such as `inner_surface(mesh)` or `facets_in(mesh, name)`.

    It pushes against the material; a positive pressure on an outer surface compresses the body. By default the pressure
    is the control of the step, one number. Openings need caps: your own, or `cap=True`. The force of a cap acts on its
    rim.

    Raises:
        InputError: as for `closed_surface`, or the pressure is not finite.
    """
    surface = closed_surface(mesh, facets, cap=cap)
    nodes = facet_nodes(mesh, surface)
    vertices, dimension = np.unique(nodes), mesh.dimension
    parameters = Pressure(None if pressure is None else material("pressure", pressure, 1, "chamber", FINITE))

    def prepare(parameters: Pressure, context: Context) -> tuple[Array, Array]:
        value = value_or_control(parameters.pressure, name, context, (), "the gauge pressure in Pa")
        # The sum does not depend on the origin; rounding is smallest for an origin near the chamber.
        centre = jax.lax.stop_gradient(context.x[vertices].mean(axis=0))
        return jnp.broadcast_to(value, len(nodes)), jnp.broadcast_to(centre, (len(nodes), dimension))

    def energy(x: Corners, facet: tuple[Array, Array]) -> Scalar:
        value, centre = facet
        rows = [[coordinate - centre[i] for i, coordinate in enumerate(corner)] for corner in x]
        return -value * determinant(rows) / math.factorial(dimension)

    def quadratic_energy(x: Corners, facet: tuple[Array, Array]) -> Scalar:
        value, centre = facet
        return -value * enclosed_volume(jnp.asarray(x) - centre, np.arange(nodes.shape[1])[None])

    linear, control = mesh.midsides is None, () if pressure is None else None
    return Term(name, nodes, energy if linear else quadratic_energy, parameters, prepare, linear, control, mesh=mesh)


def gas(
    mesh: Mesh,
    facets: ArrayLike,
    *,
    pressure: float | None = 0.0,
    ambient: float = ATMOSPHERE,
    cap: bool = False,
    name: str = "gas",
) -> Term:
    """A sealed amount of gas at constant temperature in a chamber; facets and caps as for `pressure`.

    Args:
        pressure: gauge pressure in Pa of the gas in the rest shape; it sets the amount n R T = (p + p_a) V0. With
            `None`, the amount in J is the control of the step, as for a pump.
        ambient: ambient pressure in Pa.
        cap: close openings.

    Raises:
        InputError: as for `closed_surface`, no gas, or a chamber with more than `MOST_VERTICES` vertices.
    """
    nodes = facet_nodes(mesh, closed_surface(mesh, facets, cap=cap))
    vertices, local = np.unique(nodes, return_inverse=True)
    local, volume = local.reshape(nodes.shape), float(enclosed_volume(mesh.vertices, nodes))
    if len(vertices) > MOST_VERTICES:
        raise InputError(
            f"the chamber of '{name}' has {len(vertices)} vertices; expected at most {MOST_VERTICES}, because the gas "
            "couples all of them: use a coarser mesh, or a prescribed pressure"
        )
    if not volume > 0:
        raise InputError(f"the surface of '{name}' encloses {volume:.3g} in the rest shape; expected a positive volume")
    require_positive(ambient=ambient)
    amount = None
    if pressure is not None:
        require_positive(**{"the absolute pressure, pressure + ambient,": pressure + ambient})
        amount = jnp.asarray((pressure + ambient) * volume, float)
    parameters = Gas(amount, jnp.asarray(ambient, float))

    def prepare(parameters: Gas, context: Context) -> tuple[Array, ...]:
        value = value_or_control(parameters.amount, name, context, (), "the amount n R T of gas in J")
        centre = jax.lax.stop_gradient(context.x[vertices].mean(axis=0))
        return value[None], parameters.ambient[None], centre[None]

    def energy(x: Corners, chamber: tuple[Any, ...]) -> Scalar:
        amount, ambient, centre = chamber
        now = enclosed_volume(jnp.asarray(x) - centre, local)
        # The energy is NaN without a positive volume, so no step accepts it.
        return -amount * jnp.log(now / volume) + ambient * (now - volume)

    control = () if pressure is None else None
    return Term(name, vertices[None], energy, parameters, prepare, unrolled=False, control=control, mesh=mesh)
