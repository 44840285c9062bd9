"""Springs, muscles (springs with a driven rest length) and tendons: frictionless cords along a path through a body.

    of given length:  ½ k max(0, L(x) - l)²      of given tension:  T L(x),      L = sum over segments |p_{i+1} - p_i|

A tendon pulls and never pushes. A point p of its path is a vertex, or a point fixed in an element. The cord slides
through the points with the same tension everywhere, so its length couples all points: a tendon is one element.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import SIDES
from dln_jax.softbody.terms.term import (
    NOT_NEGATIVE,
    Context,
    Corners,
    Indices,
    Numbers,
    Term,
    material,
    value_or_control,
    vertex_rows,
)
from dln_jax.types import InputError, Scalar, require_positive

_OUTSIDE = 1e-9
"""Smallest barycentric coordinate accepted for a point on the surface, to allow for rounding."""


class Springs(NamedTuple):
    """Parameters of springs, one for all [] or one per spring [m]."""

    stiffness: Float[Array, "..."]
    """In N/m."""
    rest_length: Float[Array, "..."] | None
    """In m; `None` means the length in the rest shape."""


class Muscles(NamedTuple):
    """Parameters of muscles, one for all [] or one per muscle [m]."""

    stiffness: Float[Array, "..."]
    """Energy per squared relative strain, in J."""


class TendonOfLength(NamedTuple):
    """Parameters of a tendon with a given length."""

    stiffness: Float[Array, ""]
    """k in N/m."""
    length: Float[Array, ""] | None
    """l in m; `None` if the control sets it."""


class TendonOfTension(NamedTuple):
    """Parameters of a tendon with a given tension."""

    tension: Float[Array, ""] | None
    """T in N; `None` if the control sets it."""


def springs(
    pairs: Indices,
    *,
    stiffness: Numbers,
    rest_length: Numbers | None = None,
    softening: float = 0.0,
    name: str = "springs",
) -> Term:
    """½ k (l - l0)² for pairs of vertices, with l = sqrt(d² + softening²) and the distance d.

    The rest length l0 in m is `rest_length`, by default the length in the rest shape, with the same softening and
    without force. Without softening, the force of a compressed spring has no direction at d = 0, and its stiffness no
    bound. At this point the spring has zero force and stiffness k, which is exact for l0 = 0.
    """
    indices = vertex_rows("pairs of springs", pairs, 2)
    count = len(indices)
    if rest_length is not None:
        rest_length = material("rest_length", rest_length, count, "spring", NOT_NEGATIVE)
    parameters = Springs(material("stiffness", stiffness, count, "spring"), rest_length)

    def prepare(parameters: Springs, context: Context) -> tuple[Array, Array]:
        length = parameters.rest_length
        if length is None:
            length = _rest_lengths(context, indices, softening)
        return jnp.broadcast_to(parameters.stiffness, count), jnp.broadcast_to(length, count)

    return Term(name, indices, _energy(softening), parameters, prepare, weights=_ends)


def muscles(pairs: Indices, *, stiffness: Numbers, softening: float = 1e-3, name: str = "muscles") -> Term:
    """½ k ((l - a l0)/(a l0))² for pairs of vertices, with l = sqrt(d² + softening²) and the distance d.

    l0 is the distance in the rest shape, which must not be zero, and a > 0 the actuation: the `control` [m] of the
    step, in the order of the pairs. k is in J and softening in m.
    """
    indices = vertex_rows("pairs of muscles", pairs, 2)
    count = len(indices)
    parameters = Muscles(material("stiffness", stiffness, count, "muscle"))

    def prepare(parameters: Muscles, context: Context) -> tuple[Array, Array]:
        actuation = value_or_control(None, name, context, (count,), "the actuation a > 0 of each muscle")
        length = actuation * _rest_lengths(context, indices, 0.0)
        return parameters.stiffness / length**2, length

    return Term(name, indices, _energy(softening), parameters, prepare, control=(count,), weights=_ends)


def _energy(softening: float):
    if softening != 0.0:
        require_positive(softening=softening)

    def energy(edge: Corners, spring: tuple[Array, Array]) -> Scalar:
        stiffness, rest_length = spring
        squared = jnp.asarray(sum(component**2 for (component,) in edge))
        deviation = (length_of(squared, softening) - rest_length) ** 2
        if softening == 0.0:
            deviation = jnp.where(squared > 0, deviation, squared + rest_length**2)
        return 0.5 * stiffness * deviation

    return energy


def _ends(_: Any) -> list[list[float]]:
    """Returns the weights of the two vertices in a spring's edge."""
    return [[-1.0], [1.0]]


def length_of(squared_distance: Float[Array, "*m"], softening: float) -> Float[Array, "*m"]:
    """Returns sqrt(d² + softening²); without softening its derivative at zero is zero."""
    if softening > 0.0:
        return jnp.sqrt(squared_distance + softening**2)
    apart = squared_distance > 0
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, squared_distance, 1.0)), 0.0)


def _rest_lengths(context: Context, indices: np.ndarray, softening: float) -> Float[Array, " m"]:
    squared = jnp.sum((context.rest[indices[:, 1]] - context.rest[indices[:, 0]]) ** 2, axis=1)
    return length_of(squared, softening)


def tendon_of_length(
    mesh: Mesh, path: ArrayLike, *, stiffness: float, length: float | None = None, name: str = "tendon"
) -> Term:
    """A tendon that pulls with stiffness k in N/m when longer than l in m, and is slack when shorter.

    Args:
        path: vertices [p], or points [p, dim] of the rest shape in m.
        length: l; by default l is the control of the step, one number. `path_length` returns the length in the rest
            shape.

    Raises:
        InputError: the path has fewer than two points, leaves the body or repeats a point, or a number is out of range.
    """
    parameters = TendonOfLength(
        material("stiffness", stiffness, 1, "tendon"),
        None if length is None else material("length", length, 1, "tendon", NOT_NEGATIVE),
    )

    def prepare(parameters: TendonOfLength, context: Context) -> tuple[Array, Array]:
        length = value_or_control(parameters.length, name, context, (), "the length of the tendon in m")
        return parameters.stiffness[None], length[None]

    def stored(now: Array, tendon: tuple[Array, Array]) -> Array:
        stiffness, length = tendon
        return 0.5 * stiffness * jnp.maximum(now - length, 0) ** 2

    return _tendon(mesh, path, name, parameters, prepare, stored, driven=length is None)


def tendon_of_tension(mesh: Mesh, path: ArrayLike, *, tension: float | None = None, name: str = "tendon") -> Term:
    """A tendon with tension T in N, by default the control of the step; path and errors as in `tendon_of_length`."""
    parameters = TendonOfTension(None if tension is None else material("tension", tension, 1, "tendon", NOT_NEGATIVE))

    def prepare(parameters: TendonOfTension, context: Context) -> Array:
        return value_or_control(parameters.tension, name, context, (), "the tension of the tendon in N")[None]

    return _tendon(mesh, path, name, parameters, prepare, lambda now, tension: tension * now, driven=tension is None)


def path_length(mesh: Mesh, path: ArrayLike, x: Any = None) -> Float[Array, ""]:
    """Returns the length in m of a tendon's path at positions x [n, dim], by default the rest shape."""
    nodes, weights = _path(mesh, path)
    return _length(jnp.asarray(weights) @ jnp.asarray(mesh.vertices if x is None else x)[nodes])


def _tendon(
    mesh: Mesh,
    path: ArrayLike,
    name: str,
    parameters: Any,
    prepare: Callable[[Any, Context], Any],
    stored: Callable[[Array, Any], Array],
    *,
    driven: bool,
) -> Term:
    nodes, weights = _path(mesh, path)

    def energy(x: Corners, tendon: Any) -> Scalar:
        return stored(_length(jnp.asarray(weights) @ jnp.asarray(x)), tendon)

    control = () if driven else None
    return Term(name, nodes[None], energy, parameters, prepare, unrolled=False, control=control, mesh=mesh)


def _path(mesh: Mesh, path: ArrayLike) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "p k"]]:
    """Returns the distinct nodes of all points, and the points' weights on them."""
    points = np.asarray(path)
    if points.ndim == 1 and points.dtype.kind in "iu":
        if ((points < 0) | (points >= len(mesh.vertices))).any():
            raise InputError(f"the path names vertices {points.tolist()}; expected 0..{len(mesh.vertices) - 1}")
        of_points, shares = points[:, None], np.ones((len(points), 1))
    else:
        of_points, shares = _located(mesh, points)
    if len(points) < 2:
        raise InputError(f"the path has {len(points)} points; expected at least 2: vertices [p] or positions [p, dim]")
    nodes, number = np.unique(of_points[shares != 0], return_inverse=True)
    weights = np.zeros((len(points), len(nodes)))
    weights[np.nonzero(shares)[0], number.reshape(-1)] = shares[shares != 0]
    steps = np.linalg.norm(np.diff(weights @ mesh.vertices[nodes], axis=0), axis=1)
    if not (steps > 0).all():
        at = int(np.argmin(steps))
        raise InputError(f"points {at} and {at + 1} of the path coincide; leave one out")
    return nodes, weights


def _length(points: Float[Array, "p dim"]) -> Float[Array, ""]:
    return jnp.sum(length_of(jnp.sum(jnp.diff(points, axis=0) ** 2, axis=1), 0.0))


def _located(mesh: Mesh, points: ArrayLike) -> tuple[Int[np.ndarray, "p nodes"], Float[np.ndarray, "p nodes"]]:
    """Returns the nodes of the elements that contain points of the rest shape (in m), and the shape functions there.

    A point moves with the body: its position is the sum of its nodes' positions, weighted by these values.

    Raises:
        InputError: points of a wrong shape, or a point outside the body.
    """
    positions = np.asarray(points, dtype=float)
    if positions.ndim != 2 or positions.shape[1] != mesh.dimension or not np.isfinite(positions).all():
        raise InputError(
            f"points have shape {list(positions.shape)}; expected finite numbers [p, {mesh.dimension}], in m"
        )
    corners = mesh.vertices[mesh.elements]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    later = np.linalg.solve(edges, (positions[:, None] - corners[:, 0])[..., None])[..., 0]
    coordinates = np.concatenate([1 - later.sum(axis=2, keepdims=True), later], axis=2)
    elements = coordinates.min(axis=2).argmax(axis=1)
    shares = coordinates[np.arange(len(positions)), elements]
    if len(outside := np.flatnonzero(shares.min(axis=1) < -_OUTSIDE)):
        point = positions[outside[0]].tolist()
        raise InputError(f"point {outside[0]} at {point} m is outside the body; expected a point in an element")
    if mesh.midsides is not None:
        i, j = np.array(SIDES[mesh.dimension]).T
        shares = np.concatenate([shares * (2 * shares - 1), 4 * shares[:, i] * shares[:, j]], axis=1)
    return mesh.nodes[elements], shares
