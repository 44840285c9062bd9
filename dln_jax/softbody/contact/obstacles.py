"""Contact of vertices with rigid obstacles, by a barrier on their signed distance.

    E = kappa A b(d²) / h³

with the signed distance d of a vertex to the obstacle, positive outside, and b of `barrier`. The distance limits the
steps of the minimisation, so no vertex enters an obstacle at any speed. Only vertices are in contact: an obstacle
smaller than the triangles of a body can pass between the vertices. Model it as a held body in a `body_contact`.

An obstacle is a NamedTuple of differentiable arrays with a method `distance`: position in m -> signed distance in m. It
must not overestimate the distance (its slope is at most 1) and must be twice differentiable almost everywhere outside
the obstacle. With friction, an obstacle also has the property `pose` (`terms.term`). To move an obstacle, change its
parameters from step to step, by less than the gap; friction takes its velocity from the change of its pose.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.softbody.contact.barrier import SLIDING, Contact, ContactParameters, barrier, contact_parameters
from dln_jax.softbody.contact.candidates import areas, surface_of
from dln_jax.softbody.contact.distances import longest_step
from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.terms.contact import motion_of, plane_pose, slip_of
from dln_jax.softbody.terms.term import Context, Numbers, Pose, vector
from dln_jax.solvers.elements.moving import Elements, MovingEnergy
from dln_jax.types import InputError, require_positive


class HalfSpace(NamedTuple):
    """The points below a plane."""

    normal: Float[Array, " dim"]
    """Outward normal, of any length."""
    offset: Float[Array, ""]
    """Distance of the plane from the origin along the normal, in m."""

    @property
    def pose(self) -> Pose:
        """As in `PlaneContact`."""
        return plane_pose(self.normal, self.offset)

    def distance(self, x: Array) -> Array:
        """Exact."""
        return jnp.sum(x * self.normal) / jnp.linalg.norm(self.normal) - self.offset


class Capsule(NamedTuple):
    """The points within a radius of a segment; a sphere if both ends coincide."""

    start: Float[Array, " dim"]
    end: Float[Array, " dim"]
    radius: Float[Array, ""]
    """In m."""

    @property
    def pose(self) -> Pose:
        """The segment, without spin about its axis."""
        along = self.end - self.start
        squared = jnp.sum(along**2)
        return self.start, along[None] / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))

    def distance(self, x: Array) -> Array:
        """Exact."""
        along, w = self.end - self.start, x - self.start
        squared = jnp.sum(along**2)
        s = jnp.clip(jnp.sum(w * along) / jnp.where(squared > 0, squared, 1.0), 0.0, 1.0)
        return jnp.linalg.norm(w - s * along) - self.radius


class Box(NamedTuple):
    """A box with sides along the rows of a rotation."""

    centre: Float[Array, " dim"]
    half_lengths: Float[Array, " dim"]
    """In m."""
    rotation: Float[Array, "dim dim"]
    """Orthonormal rows: the directions of the sides."""

    @property
    def pose(self) -> Pose:
        """Centre and sides."""
        return self.centre, self.rotation

    def distance(self, x: Array) -> Array:
        """Exact."""
        beyond = jnp.abs(self.rotation @ (x - self.centre)) - self.half_lengths
        squared = jnp.sum(jnp.maximum(beyond, 0.0) ** 2)
        away = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
        return jnp.where(squared > 0, away, jnp.max(beyond))


class Heightfield(NamedTuple):
    """Ground below a smooth surface: the cubic B-spline of heights on a lattice over the horizontal axes."""

    heights: Float[Array, "..."]
    """Control points in m, [k] in the plane or [k, l] in space; beyond the lattice the ground is level."""
    origin: Float[Array, " horizontal"]
    """Position of the first control point, in m."""
    spacing: Float[Array, ""]
    """Lattice spacing in m."""

    @property
    def pose(self) -> Pose:
        """The ground shifts with its lattice; changes of heights cause no tangential motion."""
        origin = jnp.pad(self.origin, (0, 1))
        return origin, jnp.zeros((0, len(origin)), origin.dtype)

    def distance(self, x: Array) -> Array:
        """Lower bound of the true distance: the height over sqrt(1 + s²), with the largest slope s of the control
        points."""
        at = (x[:-1] - self.origin) / self.spacing
        ground = self.heights
        for axis in range(ground.ndim - 1, -1, -1):
            ground = _spline(ground, at[axis])
        squared = sum(jnp.max(jnp.diff(self.heights, axis=i) ** 2) for i in range(self.heights.ndim))
        return (x[-1] - ground) / jnp.sqrt(1 + squared / self.spacing**2)


def half_space(normal: Numbers, offset: float = 0.0) -> HalfSpace:
    """Returns the half-space n·x < offset in m, for the unit normal n."""
    normal = vector("the normal of a half-space", normal, zero_allowed=False)
    return HalfSpace(normal, jnp.asarray(offset, float))


def capsule(start: Numbers, end: Numbers, radius: float) -> Capsule:
    """Returns the points within a radius in m of the segment between two points."""
    require_positive(radius=radius)
    first, last = vector("the start of a capsule", start), vector("the end of a capsule", end)
    return Capsule(first, last, jnp.asarray(radius, float))


def sphere(centre: Numbers, radius: float) -> Capsule:
    """Returns the points within a radius in m of a centre."""
    return capsule(centre, centre, radius)


def box(centre: Numbers, half_lengths: Numbers, rotation: Any = None) -> Box:
    """Returns a box of half lengths in m along the rows of a rotation (by default the axes)."""
    lengths = vector("the half lengths of a box", half_lengths, zero_allowed=False)
    rows = jnp.eye(len(lengths)) if rotation is None else jnp.asarray(rotation, float)
    return Box(vector("the centre of a box", centre), lengths, rows)


def heightfield(heights: Any, origin: Numbers, spacing: float) -> Heightfield:
    """Returns the ground below the cubic B-spline of heights in m, [k] or [k, l]."""
    require_positive(spacing=spacing)
    heights = jnp.asarray(heights, float)
    if heights.ndim not in (1, 2):
        raise InputError(f"heights has shape {heights.shape}; expected [k] in the plane or [k, l] in space")
    return Heightfield(heights, jnp.asarray(origin, float).reshape(heights.ndim), jnp.asarray(spacing, float))


def obstacle_contact(
    mesh: Mesh,
    obstacle: Any,
    *,
    distance: float,
    stiffness: Numbers,
    friction: Numbers | None = None,
    threshold_speed: float = 1e-3,
    name: str = "obstacle",
) -> Contact:
    """Contact of the boundary's vertices with an obstacle; other arguments as for `body_contact`.

    Raises:
        InputError: a number is not positive, a vertex is inside the obstacle in the rest shape, or a shape with
            friction has no pose.
    """
    require_positive(distance=distance, threshold_speed=threshold_speed)
    if friction is not None and not hasattr(obstacle, "pose"):
        raise InputError(f"the obstacle '{name}' has no property `pose`; friction needs one")
    surface = surface_of(mesh)
    parameters = contact_parameters(distance, stiffness, friction, obstacle)
    distances = jax.vmap(type(obstacle).distance, (None, 0))
    inside = distances(obstacle, jnp.asarray(mesh.vertices[surface.vertices])) <= 0
    if inside.any():
        vertex = surface.vertices[int(jnp.argmax(inside))]
        raise InputError(
            f"vertex {vertex} ({int(inside.sum())} in all) is inside the obstacle '{name}' in the rest shape; "
            "move the body or the obstacle"
        )
    indices = jnp.asarray(surface.vertices)[:, None]
    every = Elements(indices, (), jnp.asarray(False))

    def describe(x: Array, elements: Elements, data: tuple[ContactParameters, Array]) -> tuple[Any, Array, Array]:
        parameters, rest = data
        strength = parameters.stiffness / parameters.distance**3 * areas(surface, rest)[0]
        count = len(strength)
        repeated = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), parameters.shape)
        return repeated, strength, jnp.broadcast_to(parameters.distance**2, (count,))

    def energy(x: Float[Array, "1 dim"], data: tuple[Any, Array, Array]) -> Float[Array, ""]:
        shape, strength, near = data
        d = shape.distance(x[0])
        # Inside the obstacle the energy is infinite, so no step ends there.
        return jnp.where(d > 0, strength * barrier(d**2, near)[0], jnp.inf)

    def longest(x: Array, step: Array, elements: Elements, data: tuple[ContactParameters, Array]) -> Array:
        def at(t: Array) -> Array:
            moved = x[surface.vertices] + t[:, None] * step[surface.vertices]
            return distances(data[0].shape, moved)

        return longest_step(at, jnp.linalg.norm(step[surface.vertices], axis=1))

    def hessian(x: Array, data: Any) -> Array:
        return jax.hessian(energy)(x, data).reshape(x.size, x.size)

    def prepare(parameters: ContactParameters, context: Context) -> tuple[Any, ...]:
        data = (parameters, context.rest)
        if parameters.friction is None:
            return (data,)
        x, lagged = (at[surface.vertices] for at in (context.x, context.x if context.lag is None else context.lag))
        d, slope = jax.vmap(jax.value_and_grad(parameters.shape.distance))(lagged)
        steep = jnp.linalg.norm(slope, axis=1)
        _, strength, near = describe(context.x, every, data)
        force = -2 * d * strength * barrier(d**2, near)[1] * steep
        carried = x + motion_of(name, parameters, context.before, x)
        largest = parameters.friction * force
        slip = slip_of(context, threshold_speed, carried, slope / steep[:, None], largest)
        return data, (every, (slip, jnp.ones((len(x), 1), x.dtype)))

    pushing = MovingEnergy(lambda *_: every, describe, jax.value_and_grad(energy), hessian, longest)

    def least_distance(x: Array, elements: Elements, data: tuple[ContactParameters, Array]) -> Array:
        return jnp.minimum(jnp.min(distances(data[0].shape, x[surface.vertices])), data[0].distance)

    energies = (pushing,) if friction is None else (pushing, SLIDING)
    return Contact(name, parameters, energies, prepare, least_distance, mesh, changing=False)


def _spline(values: Float[Array, "*outer k"], at: Float[Array, ""]) -> Float[Array, "*outer"]:
    """Returns the uniform cubic B-spline along the last axis; constant beyond the ends."""
    last = values.shape[-1] - 1
    at = jnp.clip(at, 0.0, last)
    first = jnp.clip(jnp.floor(at), 0, max(last - 1, 0))
    t = at - first
    weights = jnp.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]) / 6
    number = jnp.clip(first.astype(int) + jnp.arange(-1, 3), 0, last)
    return jnp.sum(weights * values[..., number], axis=-1)
