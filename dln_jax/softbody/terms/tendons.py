"""Tendons: frictionless cords along a path through a body, which pull and never push.

    of given length:  ½ k max(0, L(x) - l)²      of given tension:  T L(x),      L = sum over segments |p_{i+1} - p_i|

A point p of the path is a vertex, or a point inside an element that moves with it. The total length couples all points,
because the cord slides through them with the same tension everywhere: a tendon is one element.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.points import located
from dln_jax.softbody.terms.springs import length_of
from dln_jax.softbody.terms.term import NOT_NEGATIVE, Context, Corners, Term, control_of, material
from dln_jax.types import InputError, Scalar


class TendonOfLength(NamedTuple):
    """Parameters of a tendon with a given length."""

    stiffness: Float[Array, ""]
    """k in N/m."""
    length: Float[Array, ""] | None
    """l in m, or `None` if it is the control."""


class TendonOfTension(NamedTuple):
    """Parameters of a tendon with a given tension."""

    tension: Float[Array, ""] | None
    """T in N, or `None` if it is the control."""


def tendon_of_length(
    mesh: Mesh, path: ArrayLike, *, stiffness: float, length: float | None = None, name: str = "tendon"
) -> Term:
    """A tendon that pulls with stiffness k in N/m when longer than l in m, and is slack when shorter.

    Args:
        path: vertices [p], or points [p, dim] of the rest shape in m.
        length: l; by default l is the control of the step, one number. `path_length` returns that of the rest shape.

    Raises:
        InputError: the path has fewer than two points, leaves the body or repeats a point, or a number is out of range.
    """
    parameters = TendonOfLength(
        material("stiffness", stiffness, 1, "tendon"),
        None if length is None else material("length", length, 1, "tendon", NOT_NEGATIVE),
    )

    def prepare(parameters: TendonOfLength, context: Context) -> tuple[Array, Array]:
        length = parameters.length
        if length is None:
            length = control_of(name, context, (), "the length of the tendon in m")
        return parameters.stiffness[None], length[None]

    def stored(now: Array, tendon: tuple[Array, Array]) -> Array:
        stiffness, length = tendon
        return 0.5 * stiffness * jnp.maximum(now - length, 0) ** 2

    return _tendon(mesh, path, name, parameters, prepare, stored, driven=length is None)


def tendon_of_tension(mesh: Mesh, path: ArrayLike, *, tension: float | None = None, name: str = "tendon") -> Term:
    """A tendon with tension T in N, by default the control of the step; path and errors as in `tendon_of_length`."""
    parameters = TendonOfTension(None if tension is None else material("tension", tension, 1, "tendon", NOT_NEGATIVE))

    def prepare(parameters: TendonOfTension, context: Context) -> Array:
        tension = parameters.tension
        if tension is None:
            tension = control_of(name, context, (), "the tension of the tendon in N")
        return tension[None]

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
        of_points, shares = located(mesh, points)
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
