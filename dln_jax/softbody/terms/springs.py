"""Springs, and muscles: springs with a driven rest length."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.softbody.terms.term import (
    NOT_NEGATIVE,
    Context,
    Corners,
    Indices,
    Numbers,
    Term,
    control_of,
    material,
    vertex_pairs,
)
from dln_jax.types import Scalar, require_positive


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


def springs(
    pairs: Indices,
    *,
    stiffness: Numbers,
    rest_length: Numbers | None = None,
    softening: float = 0.0,
    name: str = "springs",
) -> Term:
    """½ k (l - l0)² for pairs of vertices, with l = sqrt(d² + softening²) and the distance d.

    The rest length l0 in m is `rest_length`, by default that of the rest shape (with the same softening, so that it
    carries no force). Without softening, the force of a compressed spring has no direction at d = 0 and its stiffness
    no bound. Exactly there, only the well-defined parts are kept (zero force, stiffness k), which is exact for l0 = 0.
    """
    indices = vertex_pairs("pairs of springs", pairs)
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
    indices = vertex_pairs("pairs of muscles", pairs)
    count = len(indices)
    parameters = Muscles(material("stiffness", stiffness, count, "muscle"))

    def prepare(parameters: Muscles, context: Context) -> tuple[Array, Array]:
        actuation = control_of(name, context, (count,), "the actuation a > 0 of each muscle")
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
    """Weights of the two vertices in a spring's edge."""
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
