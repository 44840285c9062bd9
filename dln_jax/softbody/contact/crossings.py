"""Exact test for crossing surfaces: edges that cross in the plane, and edges that cross triangles in space.

Signs of determinants of float64 coordinates are decided in rational arithmetic wherever rounding could change them.
"""

from fractions import Fraction
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from dln_jax.softbody.contact.candidates import Group, boxes, group
from dln_jax.softbody.contact.surface import surface_of
from dln_jax.softbody.mesh.mesh import Mesh


def crossings(mesh: Mesh, x: Float[np.ndarray, "n dim"]) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Returns the pairs of primitives of the boundary that have a common point at positions x, by their vertices.

    Pairs of edges in the plane, of an edge and a triangle in space; those that share a vertex are left out. Two
    triangles in space that cross always have an edge of one that crosses the other.
    """
    surface = surface_of(mesh)
    x = np.asarray(x, float)
    others = surface.edges if mesh.dimension == 2 else surface.triangles
    meet = _segments_meet if mesh.dimension == 2 else _segment_meets_triangle
    pairs = _boxes_meet(group(surface.edges, x), group(others, x), x)
    if mesh.dimension == 2:
        pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    result = []
    for one, other in pairs:
        edge, facet = surface.edges[one], others[other]
        if not set(edge) & set(facet) and meet(x[edge], x[facet]):
            result.append((tuple(edge.tolist()), tuple(facet.tolist())))
    return result


def _boxes_meet(one: Group, other: Group, x: np.ndarray) -> Int[np.ndarray, "m 2"]:
    at = jnp.asarray(x)
    of_one, of_other = (tuple(np.asarray(side) for side in boxes(of, at, at, 0.0)) for of in (one, other))
    pairs = []
    for start in range(0, len(one.primitives), 256):
        here = slice(start, start + 256)
        meet = (of_one[0][here, None] <= of_other[1]).all(axis=2) & (of_other[0] <= of_one[1][here, None]).all(axis=2)
        pairs.append(np.argwhere(meet) + np.array([start, 0]))
    return np.concatenate(pairs)


def _segments_meet(one: np.ndarray, other: np.ndarray) -> bool:
    (a, b), (c, d) = one, other
    sides = [_side(a, b, c), _side(a, b, d), _side(c, d, a), _side(c, d, b)]
    if not any(sides):
        return True  # in one line, and the boxes meet
    return sides[0] * sides[1] <= 0 and sides[2] * sides[3] <= 0


def _segment_meets_triangle(edge: np.ndarray, triangle: np.ndarray) -> bool:
    (p, q), (a, b, c) = edge, triangle
    start, end = _side(a, b, c, p), _side(a, b, c, q)
    if start * end > 0:
        return False
    if start == 0 and end == 0:
        return _meet_in_plane(edge, triangle)
    around = [_side(p, q, a, b), _side(p, q, b, c), _side(p, q, c, a)]
    return min(around) >= 0 or max(around) <= 0


def _meet_in_plane(edge: np.ndarray, triangle: np.ndarray) -> bool:
    """Whether an edge in the plane of a triangle meets it, in the projection along the longest axis of its normal."""
    a, b, c = triangle
    axis = int(np.argmax(np.abs(np.cross(b - a, c - a))))
    edge, triangle = np.delete(edge, axis, axis=1), np.delete(triangle, axis, axis=1)
    if any(_segments_meet(edge, triangle[[i, (i + 1) % 3]]) for i in range(3)):
        return True
    sides = [_side(triangle[i], triangle[(i + 1) % 3], edge[0]) for i in range(3)]
    return min(sides) >= 0 or max(sides) <= 0


def _side(*points: np.ndarray) -> int:
    """Sign of the orientation of dim + 1 points."""
    rows = np.stack([point - points[0] for point in points[1:]])
    value = float(np.linalg.det(rows))
    size = float(np.prod(np.linalg.norm(rows, axis=1))) + 1e-300
    if abs(value) > 1e-12 * size * (1 + np.abs(np.stack(points)).max() / np.abs(rows).max(initial=1e-300)):
        return 1 if value > 0 else -1
    exact = [
        [Fraction(float(u)) - Fraction(float(v)) for u, v in zip(point, points[0], strict=True)] for point in points[1:]
    ]
    determinant = _determinant(exact)
    return (determinant > 0) - (determinant < 0)


def _determinant(rows: list[list[Any]]) -> Any:
    if len(rows) == 2:
        return rows[0][0] * rows[1][1] - rows[0][1] * rows[1][0]
    minors = (_determinant([[row[j] for j in range(3) if j != i] for row in rows[1:]]) for i in range(3))
    return sum((-1) ** i * rows[0][i] * minor for i, minor in enumerate(minors))
