"""Frames of bodies: an origin and axes that are weighted sums of the vertices' positions.

    o = w x,    a = axes x / |axes x|,    R = rows (a, b),    b = a turned by 90 degrees          in the plane
    R = rows (a, c x a, c),    c = a x (second axis) normalised                                    in space

Observations in such a frame do not change if the body is moved or turned.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Frame(NamedTuple):
    """Weights of the vertices."""

    origin: Float[np.ndarray, " n"]
    """They sum to 1."""
    axes: Float[np.ndarray, "axes n"]
    """One axis in the plane, two in space; their weights sum to 0."""


def fitted_frame(vertices: Float[np.ndarray, "n dim"]) -> Frame:
    """Frame that follows all vertices: their mean, and the images of x (and y) under the least-squares affine map."""
    count, dimension = vertices.shape
    offsets = vertices - vertices.mean(axis=0)
    return Frame(np.full(count, 1 / count), np.linalg.pinv(offsets)[: dimension - 1])


def axes_of(frame: Frame, x: Float[Array, "n dim"]) -> Float[Array, "dim dim"]:
    """Returns the rotation R into the frame, whose rows are the axes."""
    a, *others = jnp.asarray(frame.axes, x.dtype) @ x
    a = a / jnp.linalg.norm(a)
    if not others:
        return jnp.stack([a, jnp.stack([-a[1], a[0]])])
    c = jnp.cross(a, others[0])
    c = c / jnp.linalg.norm(c)
    return jnp.stack([a, jnp.cross(c, a), c])
