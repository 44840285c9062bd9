"""Pressure in chambers: a gauge pressure, or a sealed amount of gas.

    pressure:  -p V(x)                                         force on every facet:  p times its area, along its normal
    gas:       -n R T ln(V(x)/V0) + p_a (V(x) - V0)             p = n R T / V - p_a

with the volume V that a closed surface of facets encloses (`mesh.surfaces`), in m³, or m² for 1 m of thickness. The
pressure follows the surface as it moves. A gauge pressure is a sum over facets. A gas couples all vertices of its
chamber, because its pressure falls as the chamber grows: it is one element, whose Hessian is dense.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import determinant
from dln_jax.softbody.mesh.surfaces import closed_surface, enclosed_volume, facet_nodes
from dln_jax.softbody.terms.term import Bound, Context, Corners, Term, control_of, material
from dln_jax.types import InputError, Scalar, require_positive

MOST_VERTICES = 800
"""Largest chamber of a sealed gas: its dense Hessian has (vertices times dimension)² entries, stored twice."""
ATMOSPHERE = 101325.0
"""Standard ambient pressure, in Pa."""
FINITE = Bound(np.isfinite, "a finite number")


class Pressure(NamedTuple):
    """Parameters of a gauge pressure."""

    pressure: Float[Array, ""] | None
    """Gauge pressure p in Pa, or `None` if it is the control."""


class Gas(NamedTuple):
    """Parameters of a sealed gas."""

    amount: Float[Array, ""] | None
    """n R T in J, or `None` if it is the control."""
    ambient: Float[Array, ""]
    """Ambient pressure p_a in Pa."""


def pressure(
    mesh: Mesh, facets: ArrayLike, *, pressure: float | None = None, cap: bool = False, name: str = "pressure"
) -> Term:
    """Gauge pressure in Pa in a chamber with these facets, such as `inner_surface(mesh)` or `facets_in(mesh, name)`.

    It pushes against the material; a positive pressure on an outer surface compresses the body. By default the pressure
    is the control of the step, one number. Openings need caps, your own or `cap=True`; a cap's force acts on its rim.

    Raises:
        InputError: as for `closed_surface`, or the pressure is not finite.
    """
    surface = closed_surface(mesh, facets, cap=cap)
    nodes = facet_nodes(mesh, surface)
    vertices, dimension = np.unique(nodes), mesh.dimension
    parameters = Pressure(None if pressure is None else material("pressure", pressure, 1, "chamber", FINITE))

    def prepare(parameters: Pressure, context: Context) -> tuple[Array, Array]:
        value = parameters.pressure
        if value is None:
            value = control_of(name, context, (), "the gauge pressure in Pa")
        # The sum does not depend on the origin; its rounding is smallest near the chamber.
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
    """A sealed amount of gas at constant temperature in a chamber; facets and caps are those of `pressure`.

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
            "couples all of them: use a coarser mesh, or a given pressure"
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
        value = parameters.amount
        if value is None:
            value = control_of(name, context, (), "the amount n R T of gas in J")
        centre = jax.lax.stop_gradient(context.x[vertices].mean(axis=0))
        return value[None], parameters.ambient[None], centre[None]

    def energy(x: Corners, chamber: tuple[Any, ...]) -> Scalar:
        amount, ambient, centre = chamber
        now = enclosed_volume(jnp.asarray(x) - centre, local)
        # The energy of a volume that is not positive is NaN, so that no step accepts it.
        return -amount * jnp.log(now / volume) + ambient * (now - volume)

    control = () if pressure is None else None
    return Term(name, vertices[None], energy, parameters, prepare, unrolled=False, control=control, mesh=mesh)
