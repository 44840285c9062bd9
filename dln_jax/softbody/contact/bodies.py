"""Contact between and within bodies, by barriers on surface distances (Li et al. 2020).

The energies sum over all pairs without a common vertex: vertex and edge in the plane, vertex and triangle or two edges
in space. Every Newton step searches for near pairs again, in lists of fixed capacity. Continuous collision detection
limits the steps, so no pair ever crosses.

Friction is lagged: it uses the normal forces and tangent planes at the start of the time step, or at the previous
solution if `make_step` iterates,

    D = mu lambda f(|u|),    u = (1 - n nᵀ) sum_i w_i (x_i - x_i(start)),

with the smooth f of `terms.contact`.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.softbody.contact.barrier import (
    MOLLIFIED,
    SLIDING,
    Contact,
    ContactParameters,
    Pair,
    contact_parameters,
    normal_force,
    pair_gradient,
    pair_hessian,
)
from dln_jax.softbody.contact.candidates import (
    Group,
    Surface,
    areas,
    boxes,
    group,
    meeting,
    meetings,
    pairs_near,
    places,
    surface_of,
)
from dln_jax.softbody.contact.distances import (
    EDGE_EDGE,
    POINT_TRIANGLE,
    longest_step,
    speed_bound,
    squared_distance,
    stencil_of,
)
from dln_jax.softbody.mesh.mesh import Mesh, components_of_vertices
from dln_jax.softbody.terms.contact import slip_of
from dln_jax.softbody.terms.term import Context, Numbers
from dln_jax.solvers.elements.moving import Elements, MovingEnergy
from dln_jax.types import InputError, require_positive

_AT_ONCE = 256
"""Number of distances per turn of a loop; no list is shorter."""


class Kind(NamedTuple):
    """The pairs of two kinds of primitives."""

    one: Group
    other: Group
    number: int
    """Number of the kind in `distances`."""
    neighbours: tuple[int, int]
    """Number of cluster pairs, and of primitive pairs, with intersecting boxes in the rest shape."""


def body_contact(
    mesh: Mesh,
    *,
    distance: float,
    stiffness: Numbers,
    friction: Numbers | None = None,
    threshold_speed: float = 1e-3,
    capacity: int | None = None,
    name: str = "contact",
) -> Contact:
    """Contact of all bodies of a mesh with each other and with themselves.

    Args:
        mesh: the bodies; their boundaries are in contact.
        distance: h in m; surfaces repel each other when closer. Well below the edge length.
        stiffness: kappa in Pa. The gap under a pressure p depends only on p / kappa and h: with kappa = p it is about h
            / 2. Bodies never cross at any stiffness.
        friction: Coulomb's coefficient, fully developed at the threshold speed in m/s.
        capacity: slots in the list of near pairs, for every kind of pair; by default two per boundary vertex and at
            least 128. A step that needs more does not converge, and its `Info.overflow` is true.
        name: key of its parameters in `Params.terms`.

    Raises:
        InputError: a number is not positive, or surfaces of one body are closer than the distance in the rest shape and
            would repel each other.
    """
    require_positive(distance=distance, threshold_speed=threshold_speed, capacity=1 if capacity is None else capacity)
    surface = surface_of(mesh)
    kinds = _kinds(surface, mesh.vertices, distance)
    capacity = max(_AT_ONCE // 2, 2 * len(surface.vertices) if capacity is None else capacity)
    parameters = contact_parameters(distance, stiffness, friction)
    _require_gaps(mesh, kinds, distance)
    barrier = MovingEnergy(
        elements=partial(_near, kinds, capacity),
        describe=partial(_described, surface),
        gradient=pair_gradient,
        hessian=pair_hessian,
        longest=_longest,
    )

    def prepare(parameters: ContactParameters, context: Context) -> tuple[Any, ...]:
        data = (parameters, context.rest)
        if parameters.friction is None:
            return (data,)
        # The pairs in frictional contact, with normal forces at the start of the step or at `context.lag`.
        x = context.x if context.lag is None else context.lag
        elements = jax.lax.stop_gradient(barrier.elements(x, jnp.zeros_like(x), data))
        pairs = barrier.describe(x, elements, data)
        force, normal, weights = jax.vmap(normal_force)(x[elements.indices], pairs)
        start = jnp.einsum("mk,mki->mi", weights, context.x[elements.indices])
        slip = slip_of(context, threshold_speed, start, normal, parameters.friction * force)
        return data, (elements, (slip, weights))

    def least_distance(x: Float[Array, "n dim"], elements: Elements, data: Any) -> Float[Array, ""]:
        _, kind, used = elements.data
        squares = jax.vmap(squared_distance)(x[elements.indices], kind)
        farthest = data[0].distance ** 2
        return jnp.sqrt(jnp.minimum(jnp.min(jnp.where(used, squares, farthest)), farthest))

    energies = (barrier,) if friction is None else (barrier, SLIDING)
    return Contact(name, parameters, energies, prepare, least_distance, mesh)


def _kinds(surface: Surface, rest: np.ndarray, distance: float) -> tuple[Kind, ...]:
    vertices, edges = group(surface.vertices[:, None], rest), group(surface.edges, rest)

    def kind(one: Group, other: Group, number: int) -> Kind:
        return Kind(one, other, number, meetings(one, other, rest, distance))

    if surface.sides is None:
        return (kind(vertices, edges, 0),)
    triangles = group(surface.facets, rest)
    return kind(vertices, triangles, POINT_TRIANGLE), kind(edges, edges, EDGE_EDGE)


def _require_gaps(mesh: Mesh, kinds: tuple[Kind, ...], distance: float) -> None:
    """Refuses a distance at which a body repels itself in its rest shape; different bodies may be as close."""
    rest, body = jnp.asarray(mesh.vertices), components_of_vertices(mesh)
    for kind in kinds:
        one, other = meeting(*(boxes(of, rest, rest, distance / 2) for of in (kind.one, kind.other))).T
        one, other = kind.one.primitives[one], kind.other.primitives[other]
        apart = ~(one[:, :, None] == other[:, None, :]).any(axis=(1, 2)) & (body[one[:, 0]] == body[other[:, 0]])
        corners = np.concatenate([one, other], axis=1)[apart]
        if not len(corners):
            continue
        near = jax.jit(jax.vmap(squared_distance, (0, None)))(rest[corners], kind.number) < distance**2
        if near.any():
            raise InputError(
                f"the vertices {corners[np.argmax(near)].tolist()} of one body are closer in its rest shape than the "
                "contact distance and would repel each other; give a smaller distance"
            )


def _near(kinds: tuple[Kind, ...], capacity: int, x: Array, step: Array, data: Any) -> Elements:
    """Lists the pairs that may come closer than h between x and x + step.

    The data of a slot are the two primitives, the number of its kind in `distances`, and whether it is used.
    """
    parameters, _ = data
    lists = []
    for kind in kinds:
        margin = parameters.distance / 2
        of_one = boxes(kind.one, x, x + step, margin)
        of_other = of_one if kind.one is kind.other else boxes(kind.other, x, x + step, margin)
        # Boxes of neighbours in one surface always meet, so these lists are longer than the lists of near pairs.
        clusters, primitives = (count + count // 2 + 2 * capacity for count in kind.neighbours)
        pairs, used, overflow = pairs_near(kind.one, kind.other, of_one, of_other, (clusters, primitives))
        ends = jnp.asarray(kind.one.primitives)[pairs[:, 0]], jnp.asarray(kind.other.primitives)[pairs[:, 1]]
        lists.append((pairs, used, overflow, np.full(len(used), kind.number), jnp.concatenate(ends, axis=1)))
    pairs, used, overflows, numbers, corners = zip(*lists, strict=True)
    pairs, used, corners = (jnp.concatenate(parts) for parts in (pairs, used, corners))
    number = np.concatenate(numbers)
    near = used & _within_reach(x, step, corners, number, used, parameters.distance)
    chosen, here, too_many = places(near, capacity * len(kinds))
    indices = jnp.where(here[:, None], corners[chosen], jnp.arange(corners.shape[1]))
    overflow = jnp.stack([too_many, *overflows]).any()
    return Elements(indices, (pairs[chosen], jnp.asarray(number)[chosen], here), overflow)


def _within_reach(x: Array, step: Array, corners: Array, number: np.ndarray, used: Array, distance: Array) -> Array:
    """Returns whether pairs can come within a distance during a step, from their distance and speed bound.

    Measures only the used slots, a fraction of the list.
    """
    order = jnp.argsort(~used)
    kinds = jnp.asarray(number)

    def measure(turn: Array, near: Array) -> Array:
        here = jax.lax.dynamic_slice_in_dim(order, jnp.minimum(turn * _AT_ONCE, len(order) - _AT_ONCE), _AT_ONCE)
        at, kind = corners[here], kinds[here]
        reach = distance + jax.vmap(speed_bound)(step[at], kind)
        return near.at[here].set(jax.vmap(squared_distance)(x[at], kind) < reach**2)

    return jax.lax.fori_loop(0, -(-used.sum() // _AT_ONCE), measure, jnp.zeros_like(used))


def _described(surface: Surface, x: Array, elements: Elements, data: Any) -> Pair:
    """Returns the data of all listed pairs for the barrier at x."""
    parameters, rest = data
    pairs, number, used = elements.data
    one, other = pairs.T
    of_vertices, of_edges = areas(surface, rest)
    stencil = jax.vmap(stencil_of)(jax.lax.stop_gradient(x[elements.indices]), number)
    # Both sides count a pair of facets: in space by vertices and by edges (Li et al. 2023, section 4).
    if surface.sides is None:
        area, parallel = of_vertices[one] / 2, jnp.zeros_like(rest, shape=one.shape)
    else:
        a, b, c, d = (rest[corner] for corner in elements.indices.T)
        edges = used & (number == EDGE_EDGE)
        area = jnp.where(edges, of_edges[one] + of_edges[other], of_vertices[one]) / 4
        parallel = jnp.where(edges, MOLLIFIED * jnp.sum((b - a) ** 2, axis=1) * jnp.sum((d - c) ** 2, axis=1), 0)
    strength = jnp.where(used, parameters.stiffness / parameters.distance**3 * area, 0)
    return Pair(stencil, strength, jnp.broadcast_to(parameters.distance**2, area.shape), parallel)


def _longest(x: Array, step: Array, elements: Elements, data: Any) -> Array:
    """Returns the largest fraction of the step without a crossing of a listed pair."""
    at, moved, (_, number, used) = x[elements.indices], step[elements.indices], elements.data

    def distances(t: Array) -> Array:
        return jnp.sqrt(jax.vmap(squared_distance)(at + t[:, None, None] * moved, number))

    bound = jax.vmap(speed_bound)(moved, number)
    return longest_step(distances, jnp.where(used, bound, 0))
