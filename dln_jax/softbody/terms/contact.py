"""Contact of vertices with rigid surfaces, by a smooth penalty, and the friction there.

    V = k phi(d),   phi = 0 for d >= 0,  -d³/(6 w) for -w <= d < 0,  d²/2 + w d/2 + w²/6 for d < -w

with the signed distance d to the surface. phi is twice continuously differentiable for w > 0; a vertex at rest lies
at a depth where k |phi'(d)| carries its weight. Contact and friction are one term, since they share the parameters
of the surface: friction takes its normal force from the same k, by which it can be differentiated. A contact
without a friction coefficient computes no friction.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.softbody.terms.friction import Slip, friction_energy, lagged_slip
from dln_jax.softbody.terms.parameters import (
    NOT_NEGATIVE,
    Indices,
    Numbers,
    material,
    require_dimension,
    vector,
    vertex_list,
)
from dln_jax.softbody.terms.term import Context, Corners, Term
from dln_jax.types import Scalar, require_positive


class PlaneContact(NamedTuple):
    """Parameters of a plane; stiffness and friction are for all vertices [] or for each [m]."""

    normal: Float[Array, " dim"]
    """Pointing out of the ground; its length does not matter."""
    offset: Float[Array, ""]
    """Distance of the plane from the origin along the normal, in m."""
    stiffness: Float[Array, "..."]
    """k in N/m."""
    friction: Float[Array, "..."] | None
    """Coefficient of friction, or `None`."""


class DistanceContact(NamedTuple):
    """Parameters of a surface given by its signed distance, for all vertices [] or for each [m]."""

    stiffness: Float[Array, "..."]
    """k in N/m."""
    friction: Float[Array, "..."] | None
    """Coefficient of friction, or `None`."""


class PlaneVertex(NamedTuple):
    """What the contact of one vertex with a plane needs; [m, ...] for all."""

    normal: Float[Array, "*m dim"]
    offset: Float[Array, "*m"]
    stiffness: Float[Array, "*m"]
    slip: Slip | None


class DistanceVertex(NamedTuple):
    """What the contact of one vertex with a surface needs; [m, ...] for all."""

    stiffness: Float[Array, "*m"]
    slip: Slip | None


def plane_contact(
    vertices: Indices,
    *,
    normal: Numbers,
    offset: float = 0.0,
    stiffness: Numbers,
    width: float,
    friction: Numbers | None = None,
    threshold_speed: float = 1e-3,
    name: str = "ground",
) -> Term:
    """Contact with the half-space n·x < offset, for the unit normal n.

    Stiffness k in N/m; width w in m, where 0 means ½ k d² below the plane, which is only once continuously
    differentiable. `friction` is Coulomb's coefficient, reached at the threshold speed in m/s (`friction.py`).
    """
    indices = vertex_list("vertices in contact", vertices)
    _require_widths(width, threshold_speed)
    parameters = PlaneContact(
        vector("the normal of a plane", normal, zero_allowed=False),
        jnp.asarray(offset, dtype=float),
        *_contact_parameters(stiffness, friction, len(indices)),
    )

    def prepare(parameters: PlaneContact, context: Context) -> PlaneVertex:
        x = context.x[indices[:, 0]]
        require_dimension("the normal of a plane", parameters.normal.shape[0], x.shape[1])
        normal = parameters.normal / jnp.sqrt(jnp.sum(parameters.normal**2))
        normals = jnp.broadcast_to(normal, x.shape)
        offset, stiffness = (jnp.broadcast_to(value, len(x)) for value in (parameters.offset, parameters.stiffness))
        slip = None
        if parameters.friction is not None:
            force = stiffness * penalty_force(jnp.sum(x * normal, axis=1) - offset, width)
            slip = lagged_slip(context, x, normals, force, parameters.friction, threshold_speed)
        return PlaneVertex(normals, offset, stiffness, slip)

    def energy(x: Corners, vertex: PlaneVertex) -> Scalar:
        height = sum(vertex.normal[i] * coordinate for i, coordinate in enumerate(x[0])) - vertex.offset
        contact = vertex.stiffness * penalty(jnp.asarray(height), width)
        return contact if vertex.slip is None else contact + friction_energy(x[0], vertex.slip)

    return Term(name, indices, energy, parameters, prepare)


def distance_contact(
    vertices: Indices,
    distance: Callable[[Array], Array],
    *,
    stiffness: Numbers,
    width: float,
    friction: Numbers | None = None,
    threshold_speed: float = 1e-3,
    name: str = "obstacle",
) -> Term:
    """Contact with the body where `distance(x [dim])`, in m, is negative; the other arguments as for a plane.

    The function must be twice differentiable wherever it is negative at a vertex. Friction takes the normal from its
    gradient at the start of the step; where that vanishes (the centre of a ball), there is none.
    """
    indices = vertex_list("vertices in contact", vertices)
    _require_widths(width, threshold_speed)
    parameters = DistanceContact(*_contact_parameters(stiffness, friction, len(indices)))

    def prepare(parameters: DistanceContact, context: Context) -> DistanceVertex:
        stiffness = jnp.broadcast_to(parameters.stiffness, len(indices))
        slip = None
        if parameters.friction is not None:
            x = context.x[indices[:, 0]]
            depth, slope = jax.vmap(jax.value_and_grad(distance))(x)
            squared = jnp.sum(slope**2, axis=1)
            steep = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
            force = jnp.where(squared > 0, stiffness * penalty_force(depth, width) * steep, 0.0)
            slip = lagged_slip(context, x, slope / steep[:, None], force, parameters.friction, threshold_speed)
        return DistanceVertex(stiffness, slip)

    def energy(x: Corners, vertex: DistanceVertex) -> Scalar:
        contact = vertex.stiffness * penalty(distance(jnp.stack(x[0])), width)
        return contact if vertex.slip is None else contact + friction_energy(x[0], vertex.slip)

    return Term(name, indices, energy, parameters, prepare)


def penalty(distance: Float[Array, "*m"], width: float) -> Float[Array, "*m"]:
    """phi(d) in m²."""
    if width == 0.0:
        return jnp.where(distance < 0, 0.5 * distance**2, 0.0)
    ramp = jnp.where(distance < 0, -(distance**3) / (6.0 * width), 0.0)
    return jnp.where(distance < -width, 0.5 * distance * (distance + width) + width**2 / 6.0, ramp)


def penalty_force(distance: Float[Array, "*m"], width: float) -> Float[Array, "*m"]:
    """-phi'(d) in m: times k, the normal force."""
    if width == 0.0:
        return jnp.where(distance < 0, -distance, 0.0)
    ramp = jnp.where(distance < 0, distance**2 / (2.0 * width), 0.0)
    return jnp.where(distance < -width, -distance - 0.5 * width, ramp)


def _contact_parameters(stiffness: Numbers, friction: Numbers | None, count: int):
    if friction is not None:
        friction = material("friction", friction, count, "vertex", NOT_NEGATIVE)
    return material("stiffness", stiffness, count, "vertex"), friction


def _require_widths(width: float, threshold_speed: float) -> None:
    require_positive(threshold_speed=threshold_speed)
    if width != 0.0:
        require_positive(width=width)
