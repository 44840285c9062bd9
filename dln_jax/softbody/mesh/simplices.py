"""Volumes, shapes and facets of individual simplices, in a mesh or not.

Quadratic simplices have a mid-side node on each edge after their corners. With barycentric coordinates l, the shape
functions are l_i (2 l_i - 1) at corner i and 4 l_i l_j between corners i and j. Their quadrature points (3 in a
triangle, 4 in a tetrahedron, equal weights) integrate polynomials of degree 2 exactly (Hammer and Stroud 1956).
"""

import itertools
import math
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Array, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

AnyArray = TypeVar("AnyArray", np.ndarray, Array)

FACETS = {2: ((0, 1), (1, 2), (2, 0)), 3: ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))}
"""Corners of the facets by dimension, oriented outwards: in the plane the body lies on the left of an edge, in space
the right-hand normal of a triangle points away from the body."""

SIDES = {2: ((0, 1), (1, 2), (2, 0)), 3: ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))}
"""Corners of the edges by dimension, in the order of the mid-side nodes (VTK's order)."""
_FRACTION = {2: 1 / 6, 3: (5 - math.sqrt(5)) / 20}
"""Smallest barycentric coordinate of the quadrature points, which are its permutations."""


def simplex_volumes(vertices: Float[AnyArray, "n dim"], elements: Int[np.ndarray, "m nodes"]) -> Float[AnyArray, " m"]:
    """Returns signed areas in m² or volumes in m³: det[x1 - x0, ..., xdim - x0] / dim!, negative if inverted.

    Takes NumPy arrays, and JAX arrays for derivatives by the rest shape. Quadrature gives the volume of a quadratic
    tetrahedron with curved edges.
    """
    if elements.shape[1] > vertices.shape[1] + 1:
        return jacobians(vertices, elements).mean(axis=1) / math.factorial(vertices.shape[1])
    corners = vertices[elements]
    return determinant((corners[:, 1:] - corners[:, :1]).transpose(1, 2, 0)) / math.factorial(vertices.shape[1])


def volume_ratios(
    x: Float[AnyArray, "n dim"], rest: Float[AnyArray, "n dim"], elements: Int[np.ndarray, "m nodes"]
) -> Float[AnyArray, "m points"]:
    """Returns J = det dx/dX: one per linear element, one per quadrature point of a quadratic element."""
    if elements.shape[1] > x.shape[1] + 1:
        return jacobians(x, elements) / jacobians(rest, elements)
    return (simplex_volumes(x, elements) / simplex_volumes(rest, elements))[:, None]


def jacobians(vertices: Float[AnyArray, "n dim"], elements: Int[np.ndarray, "m nodes"]) -> Float[AnyArray, "m points"]:
    """Returns the determinants of dx/dl of quadratic elements at their quadrature points, in m² or m³."""
    J = vertices[elements].swapaxes(1, 2)[:, None] @ reference_gradients(vertices.shape[1])
    return determinant(J.transpose(2, 3, 0, 1))


def reference_gradients(dimension: int) -> Float[np.ndarray, "points nodes dim"]:
    """Returns derivatives of a quadratic element's shape functions by the barycentric coordinates l1, ..., ldim."""
    fraction, count = _FRACTION[dimension], dimension + 1
    points = np.full((count, count), fraction) + (1 - count * fraction) * np.eye(count)
    return _slopes(points, SIDES[dimension])


def _slopes(points: Float[np.ndarray, "points corners"], sides: Any) -> Float[np.ndarray, "points nodes dim"]:
    """Returns derivatives of quadratic shape functions at points with these barycentric coordinates."""
    dimension = points.shape[1] - 1
    slopes = np.concatenate([-np.ones((1, dimension)), np.eye(dimension)])
    i, j = np.array(sides).T
    corners = (4 * points - 1)[:, :, None] * slopes
    return np.concatenate([corners, 4 * (points[:, i, None] * slopes[j] + points[:, j, None] * slopes[i])], axis=1)


def facet_rule(
    dimension: int, quadratic: bool
) -> tuple[Float[np.ndarray, "points nodes"], Float[np.ndarray, "points nodes d"], Float[np.ndarray, " points"]]:
    """Returns a facet's shape functions at its quadrature points, their derivatives by its coordinates, and weights.

    Nodes are the corners, then the mid-side nodes in the order of `SIDES`. The rules (centroid; Gauss with 2 points;
    Strang and Fix 1973 with 6 points) are exact for the enclosed volume.
    """
    if not quadratic:
        slopes = np.concatenate([-np.ones((1, dimension - 1)), np.eye(dimension - 1)])
        return np.full((1, dimension), 1 / dimension), slopes[None], np.array([1.0 / math.factorial(dimension - 1)])
    if dimension == 2:
        first, weights, sides = (1 + np.array([-1.0, 1.0]) / math.sqrt(3)) / 2, np.full(2, 0.5), [(0, 1)]
        points = np.stack([first, 1 - first], axis=1)
    else:
        root, sides = math.sqrt(10), SIDES[2]
        spread, share = math.sqrt(38 - 44 * math.sqrt(2 / 5)), math.sqrt(213125 - 53320 * root)
        fractions = np.repeat([(8 - root + spread) / 18, (8 - root - spread) / 18], 3)
        weights = np.repeat([(620 + share) / 7440, (620 - share) / 7440], 3)
        points = np.where(np.tile(np.eye(3, dtype=bool), (2, 1)), 1 - 2 * fractions[:, None], fractions[:, None])
    i, j = np.array(sides).T
    values = np.concatenate([points * (2 * points - 1), 4 * points[:, i] * points[:, j]], axis=1)
    return values, _slopes(points, sides), weights


def determinant(F: Any) -> Any:
    """Returns the determinant of a 2 x 2 or 3 x 3 matrix; entries are scalars, or arrays over several matrices."""
    if len(F) == 2:
        return F[0][0] * F[1][1] - F[0][1] * F[1][0]
    cofactor = cofactors(F)
    return F[0][0] * cofactor[0][0] + F[0][1] * cofactor[0][1] + F[0][2] * cofactor[0][2]


def cofactors(F: Any) -> list[list[Any]]:
    """Returns the rows of cof F = det F F⁻ᵀ."""
    if len(F) == 2:
        return [[F[1][1], -F[1][0]], [-F[0][1], F[0][0]]]
    # Cyclic indices give the signs.
    return [
        [
            F[(i + 1) % 3][(j + 1) % 3] * F[(i + 2) % 3][(j + 2) % 3]
            - F[(i + 1) % 3][(j + 2) % 3] * F[(i + 2) % 3][(j + 1) % 3]
            for j in range(3)
        ]
        for i in range(3)
    ]


def regularity(vertices: Float[np.ndarray, "n dim"], elements: Int[np.ndarray, "m corners"]) -> Float[np.ndarray, " m"]:
    """Returns the volume of every element relative to the regular simplex with the same longest edge.

    1 for a regular simplex, 0 for a flat simplex, negative for an inverted simplex; also 0 if all corners coincide.
    """
    dim, corners = vertices.shape[1], vertices[elements]
    pairs = itertools.combinations(range(dim + 1), 2)
    longest = np.max([np.linalg.norm(corners[:, i] - corners[:, j], axis=1) for i, j in pairs], axis=0)
    scale = np.where(longest > 0, longest, 1.0)
    # Scaled before the products, so that no mesh size overflows or underflows.
    shape = determinant(((corners[:, 1:] - corners[:, :1]) / scale[:, None, None]).transpose(1, 2, 0))
    return shape / math.sqrt((dim + 1) / 2**dim)


def facets(elements: Int[np.ndarray, "m corners"]) -> Int[np.ndarray, "m corners dim"]:
    """Returns the facets of all elements, oriented outwards unless the element is inverted."""
    return elements[:, np.array(FACETS[elements.shape[1] - 1])]


def connected(rows: Int[np.ndarray, "m k"]) -> Int[np.ndarray, " m"]:
    """Returns the component of every row, counted from 0; common numbers connect rows."""
    size = int(rows.max()) + 1
    pairs = np.repeat(rows[:, 0], rows.shape[1]), rows.ravel()
    _, label = connected_components(coo_array((np.ones(rows.size), pairs), shape=(size, size)))
    return np.unique(label[rows[:, 0]], return_inverse=True)[1].reshape(-1)
