"""Contact of vertices with rigid surfaces by a smooth penalty, with smooth, lagged Coulomb friction.

    V = k phi(d),   phi = 0 for d >= 0,  -d³/(6 w) for -w <= d < 0,  d²/2 + w d/2 + w²/6 for d < -w

with the signed distance d to the surface. phi is twice continuously differentiable for w > 0. A vertex rests at the
depth where k |phi'(d)| equals its weight. Contact and friction are one term with shared parameters: the normal force
for friction comes from the same k and is differentiable by it. Without a coefficient, friction is not computed.

    D = mu lambda_n f(|u|),   u = (1 - n nᵀ)(x - x_n),   f(u) = u²/e - u³/(3 e²) for u < e,  u - e/3 beyond,

after Li et al. 2020 (Incremental Potential Contact, section 5), with the constant for f(0) = 0, and with normals n and
normal forces lambda_n at the start of the step (or at the previous solution of a repeated step, see `make_step`). The
force mu lambda_n opposes slip above the threshold speed e/dt and falls smoothly to zero below it: a block that "sticks"
on a slope creeps more slowly than the threshold. f is twice continuously differentiable. The slip e must be well above
the rounding of the positions: in float32, 1e-4 m for a body of a metre.

Contact damping adds the force c lambda (-d') to the normal force lambda = -k phi'(d), with c in s/m (Hunt and Crossley
1975). It comes from the dissipation

    c k/dt ∫ -phi'(t) (t - d_n) dt over d_n <= t <= d  =  c k/dt (Phi(d) - Phi(d_n) - phi(d) (d - d_n)),  Phi' = phi

A point mass with impact speed u rebounds at e u for any mass, k and phi (`damping_of_restitution`):

    c u (1 + e) = ln((1 + c u) / (1 - c e u))
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from scipy.optimize import brentq

from dln_jax.softbody.terms.term import (
    NOT_NEGATIVE,
    Context,
    Corners,
    Indices,
    Numbers,
    Pose,
    Term,
    material,
    require_dimension,
    vector,
    vertex_rows,
)
from dln_jax.types import InputError, Scalar, require_positive

# Below this ratio of squared slip to squared threshold, the cubic part of f is lost in rounding and its derivatives
# overflow.
_NO_SLIP = 1e-16


class PlaneContact(NamedTuple):
    """Parameters of a plane; stiffness and friction are one for all vertices [] or one per vertex [m]."""

    normal: Float[Array, " dim"]
    """Outward normal of the ground, of any length."""
    offset: Float[Array, ""]
    """Distance of the plane from the origin along the normal, in m."""
    stiffness: Float[Array, "..."]
    """k in N/m."""
    friction: Float[Array, "..."] | None
    """Coefficient of friction, or `None`."""
    damping: Float[Array, "..."] | None = None
    """c in s/m, or `None`."""

    @property
    def pose(self) -> Pose:
        """A plane turns about the origin; its normal and offset show no other tangential motion."""
        return plane_pose(self.normal, self.offset)


class Slip(NamedTuple):
    """Friction data of one vertex, or [m, ...] of all."""

    start: Float[Array, "*m dim"]
    """Position x_n at the start of the step, moved with the surface, in m."""
    normal: Float[Array, "*m dim"]
    """Unit normal n there."""
    force: Float[Array, "*m"]
    """Largest friction force mu lambda_n, in N."""
    threshold: Float[Array, "*m"]
    """Slip e per step, in m, at which friction reaches its largest force."""


def plane_contact(
    vertices: Indices,
    *,
    normal: Numbers,
    offset: float = 0.0,
    stiffness: Numbers,
    width: float,
    friction: Numbers | None = None,
    damping: Numbers | None = None,
    threshold_speed: float = 1e-3,
    name: str = "ground",
) -> Term:
    """Contact with the half-space n·x < offset, for the unit normal n.

    Stiffness k is in N/m and width w in m. Width 0 gives ½ k d² below the plane, only once continuously differentiable.
    `friction` is Coulomb's coefficient, fully developed at the threshold speed in m/s. `damping` c in s/m dissipates in
    the normal direction (`damping_of_restitution`).
    """
    require_positive(threshold_speed=threshold_speed)
    if width != 0.0:
        require_positive(width=width)
    indices = vertex_rows("vertices in contact", vertices, 1)
    count = len(indices)
    parameters = PlaneContact(
        vector("the normal of a plane", normal, zero_allowed=False),
        jnp.asarray(offset, dtype=float),
        material("stiffness", stiffness, count, "vertex"),
        *(
            None if value is None else material(what, value, count, "vertex", NOT_NEGATIVE)
            for what, value in (("friction", friction), ("damping", damping))
        ),
    )

    def height(x: Any, plane: tuple[Array, Array]) -> Scalar:
        return jnp.asarray(sum(plane[0][i] * coordinate for i, coordinate in enumerate(x)) - plane[1])

    def prepare(
        parameters: PlaneContact, context: Context
    ) -> tuple[tuple[Array, Array], Array, Slip | None, tuple[Array, Array] | None]:
        x = context.x[indices[:, 0]]
        require_dimension("the normal of a plane", parameters.normal.shape[0], x.shape[1])
        normal = jnp.broadcast_to(parameters.normal / jnp.sqrt(jnp.sum(parameters.normal**2)), x.shape)
        plane = normal, jnp.broadcast_to(parameters.offset, count)
        stiffness = jnp.broadcast_to(parameters.stiffness, count)
        carried = x + motion_of(name, parameters, context.before, x)
        braked = slip = None
        if parameters.damping is not None:
            braked = jax.vmap(height)(tuple(carried.T), plane), parameters.damping * stiffness / context.dt
        if parameters.friction is not None:
            lagged = x if context.lag is None else context.lag[indices[:, 0]]
            pressed = stiffness * penalty_force(jax.vmap(height)(tuple(lagged.T), plane), width)
            slip = slip_of(context, threshold_speed, carried, normal, parameters.friction * pressed)
        return plane, stiffness, slip, braked

    def energy(x: Corners, vertex: tuple[Any, Array, Slip | None, tuple[Array, Array] | None]) -> Scalar:
        plane, stiffness, slip, braked = vertex
        depth = height(x[0], plane)
        contact = stiffness * penalty(depth, width)
        if braked is not None:
            start, weight = braked
            lost = penalty_integral(depth, width) - penalty_integral(start, width)
            contact += weight * (lost - penalty(depth, width) * (depth - start))
        return contact if slip is None else contact + friction_energy(x[0], slip)

    return Term(name, indices, energy, parameters, prepare, lagged=parameters.friction is not None)


def plane_pose(normal: Float[Array, " dim"], offset: Float[Array, ""]) -> Pose:
    """Returns the pose of a plane with a normal of any length."""
    normal = normal / jnp.linalg.norm(normal)
    return offset * normal, normal[None]


def motion_of(
    name: str, parameters: Any, before: Mapping[str, Pose] | None, x: Float[Array, "m dim"]
) -> Float[Array, "m dim"]:
    """Returns the motion in m of points x on a term's surface since the previous pose; exactly 0 at rest."""
    if not before or name not in before:
        return jnp.zeros_like(x)
    (origin, axes), (goal, ends) = before[name], parameters.pose
    arms, change = x - origin, ends - axes
    if len(axes) != 1:
        return goal - origin + arms @ axes.T @ change
    # The smallest rotation between the axes.
    bend, along = jnp.sum(change**2) / 2, arms @ axes.T
    across = (arms @ change.T + along * bend) / (2 - bend)
    return goal - origin + along * change - across * (axes + ends)


def slip_of(
    context: Context,
    threshold_speed: float,
    start: Float[Array, "m dim"],
    normal: Float[Array, "m dim"],
    force: Float[Array, " m"],
) -> Slip:
    """Returns the friction data of a step with forces mu lambda_n; a static solve (dt infinite) has no friction."""
    moving = jnp.isfinite(context.dt)
    threshold = jnp.where(moving, threshold_speed * context.dt, 1.0)
    return Slip(start, normal, jnp.where(moving, force, 0.0), jnp.broadcast_to(threshold, force.shape))


def friction_energy(x: Any, slip: Slip) -> Scalar:
    """Returns D in J of one vertex."""
    axes = range(len(x))
    moved = [x[i] - slip.start[i] for i in axes]
    along = sum(moved[i] * slip.normal[i] for i in axes)
    ratio = jnp.asarray(sum((moved[i] - along * slip.normal[i]) ** 2 for i in axes)) / slip.threshold**2
    slipping = ratio > _NO_SLIP
    root = jnp.sqrt(jnp.where(slipping, ratio, 1.0))
    cubic = jnp.where(slipping, ratio * root, 0.0)
    return slip.force * (slip.threshold * jnp.where(ratio < 1.0, ratio - cubic / 3.0, root - 1.0 / 3.0))


def penalty(distance: Float[Array, "*m"], width: float) -> Float[Array, "*m"]:
    """Returns phi(d) in m²."""
    if width == 0.0:
        return jnp.where(distance < 0, 0.5 * distance**2, 0.0)
    ramp = jnp.where(distance < 0, -(distance**3) / (6.0 * width), 0.0)
    return jnp.where(distance < -width, 0.5 * distance * (distance + width) + width**2 / 6.0, ramp)


def penalty_force(distance: Float[Array, "*m"], width: float) -> Float[Array, "*m"]:
    """Returns -phi'(d) in m, the normal force divided by k."""
    if width == 0.0:
        return jnp.where(distance < 0, -distance, 0.0)
    ramp = jnp.where(distance < 0, distance**2 / (2.0 * width), 0.0)
    return jnp.where(distance < -width, -distance - 0.5 * width, ramp)


def penalty_integral(distance: Float[Array, "*m"], width: float) -> Float[Array, "*m"]:
    """Returns Phi(d) in m³, the integral of phi from 0."""
    if width == 0.0:
        return jnp.where(distance < 0, distance**3 / 6.0, 0.0)
    ramp = jnp.where(distance < 0, -(distance**4) / (24.0 * width), 0.0)
    deep = distance**3 / 6.0 + width * distance**2 / 4.0 + width**2 * distance / 6.0 + width**3 / 24.0
    return jnp.where(distance < -width, deep, ramp)


def damping_of_restitution(restitution: float, speed: float) -> float:
    """Returns the damping c in s/m for a rebound of a point mass at `restitution` times its speed, in m/s.

    c is exact at this speed only: slower impacts have a larger coefficient, 1 - 2/3 c u for small c u. A body also
    converts some energy into vibrations, which is not a loss of the contact.

    Raises:
        InputError: the speed is not positive, or the coefficient is not between 0.05 and 1.
    """
    require_positive(speed=speed)
    if not 0.05 <= restitution <= 1.0:
        raise InputError(f"restitution is {restitution}; expected a coefficient from 0.05 to 1")
    if restitution == 1.0:
        return 0.0

    def excess(z: float) -> float:
        return math.log1p(z) - math.log1p(-restitution * z) - z * (1 + restitution)

    return float(brentq(excess, 0.1 * (1 - restitution), (1 - 1e-15) / restitution)) / speed  # pyright: ignore
