"""Volumes, shapes and facets of bare simplices, given by positions and corners, whether they form a mesh or not."""

import itertools
import math
from typing import TypeVar

import numpy as np
from jaxtyping import Array, Float, Int

AnyArray = TypeVar("AnyArray", np.ndarray, Array)

FACETS = {2: ((0, 1), (1, 2), (2, 0)), 3: ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))}
"""Corners of each facet by dimension, outwards: in the plane the body lies on the left of an edge; in space the
right-hand normal of a triangle points away from the body."""


def simplex_volumes(
    vertices: Float[AnyArray, "n dim"], elements: Int[np.ndarray, "m corners"]
) -> Float[AnyArray, " m"]:
    """Signed areas in m² or volumes in m³: det[x1 - x0, ..., xdim - x0] / dim!, negative where the element is inverted.

    Takes NumPy and JAX arrays alike, so that it can be differentiated by the rest shape.
    """
    corners = vertices[elements]
    return determinants(corners[:, 1:] - corners[:, :1]) / math.factorial(vertices.shape[1])


def determinants(matrices: Float[AnyArray, "m dim dim"]) -> Float[AnyArray, " m"]:
    """Of 2 x 2 or 3 x 3 matrices."""
    if matrices.shape[1] == 2:
        (a, b), (c, d) = ([matrices[:, i, j] for j in range(2)] for i in range(2))
        return a * d - b * c
    (a, b, c), (d, e, f), (g, h, k) = ([matrices[:, i, j] for j in range(3)] for i in range(3))
    return a * (e * k - f * h) - b * (d * k - f * g) + c * (d * h - e * g)


def longest_edges(
    vertices: Float[np.ndarray, "n dim"], elements: Int[np.ndarray, "m corners"]
) -> Float[np.ndarray, " m"]:
    """Length of each element's longest edge, in m."""
    corners = vertices[elements]
    pairs = itertools.combinations(range(elements.shape[1]), 2)
    return np.max([np.linalg.norm(corners[:, i] - corners[:, j], axis=1) for i, j in pairs], axis=0)


def regularity(vertices: Float[np.ndarray, "n dim"], elements: Int[np.ndarray, "m corners"]) -> Float[np.ndarray, " m"]:
    """Shape of each element: its volume over that of the regular simplex with the same longest edge.

    1 for a regular simplex, 0 for a flat one, negative for an inverted one; 0 also where all corners coincide.
    """
    dim = vertices.shape[1]
    longest = longest_edges(vertices, elements)
    scale = np.where(longest > 0, longest, 1.0)
    corners = vertices[elements]
    # Scaled before it is multiplied, so that no size of the mesh overflows or underflows.
    shape = determinants((corners[:, 1:] - corners[:, :1]) / scale[:, None, None])
    return shape / math.sqrt((dim + 1) / 2**dim)


def facets(elements: Int[np.ndarray, "m corners"]) -> Int[np.ndarray, "m corners dim"]:
    """Edges of each triangle or triangles of each tetrahedron, outwards where the element is not inverted."""
    return elements[:, np.array(FACETS[elements.shape[1] - 1])]
