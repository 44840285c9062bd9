"""Exact tests for crossing surfaces and overlapping bodies: crossing edges in the plane, triangles in space.

Rational arithmetic evaluates orientation determinants of float64 coordinates where rounding could change a sign.
"""

import itertools
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from dln_jax.softbody.contact.candidates import meeting, surface_of
from dln_jax.softbody.mesh.mesh import Mesh, components_of_vertices

_ROUNDING = 1e-14
"""Rounding error of a determinant relative to the sum of the absolute values of its products: 20 units of rounding."""
_AWAY = np.array([1.0, 0.618, 0.414])
"""Direction of a ray out of a box; it avoids the vertices and edges of common meshes."""


def crossings(mesh: Mesh, x: Float[np.ndarray, "n dim"]) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Returns the pairs of boundary primitives with a common point at positions x, by their vertices.

    Pairs are two edges in the plane, an edge and a triangle in space; pairs with a common vertex are left out. If two
    triangles in space cross, an edge of one crosses the other.
    """
    surface = surface_of(mesh)
    return _crossing(np.asarray(x, float), surface.edges, surface.facets)


def count_overlaps(mesh: Mesh) -> Callable[[Float[np.ndarray, "n dim"]], int] | None:
    """Returns positions -> number of pairs of components that touch or overlap; `None` for a mesh of one component."""
    label = components_of_vertices(mesh)
    _, edges, facets, _ = surface_of(mesh)
    owners = label[facets[:, 0]]
    _, first = np.unique(label, return_index=True)
    if len(first) == 1:
        return None

    def count(x: Float[np.ndarray, "n dim"]) -> int:
        x = np.asarray(x, float)
        if not np.isfinite(x).all():
            return 0
        met = {frozenset((label[one[0]], label[other[0]])) for one, other in _crossing(x, edges, facets)}
        far = x.max(axis=0) + np.ptp(x, axis=0) * _AWAY[: mesh.dimension]
        for part, vertex in enumerate(first):
            # A ray from a point inside a closed surface crosses it an odd number of times.
            rays = np.broadcast_to([x[vertex], far], (len(facets), 2, mesh.dimension))
            odd = np.bincount(owners[_MEET[mesh.dimension](rays, x[facets])], minlength=len(first)) % 2
            met |= {frozenset((part, other)) for other in np.flatnonzero(odd)}
        return sum(len(pair) == 2 for pair in met)

    return count


def _crossing(
    x: Float[np.ndarray, "n dim"], edges: Int[np.ndarray, "e 2"], facets: Int[np.ndarray, "f dim"]
) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Returns the edges and facets with a common point but no common vertex; each pair of edges once."""
    one, other = meeting(*((x[of].min(axis=1), x[of].max(axis=1)) for of in (edges, facets))).T
    if x.shape[1] == 2:
        one, other = one[one < other], other[one < other]
    edges, facets = edges[one], facets[other]
    apart = ~(edges[:, :, None] == facets[:, None, :]).any(axis=(1, 2))
    edges, facets = edges[apart], facets[apart]
    hit = _MEET[x.shape[1]](x[edges], x[facets])
    return [(tuple(edge), tuple(facet)) for edge, facet in zip(edges[hit].tolist(), facets[hit].tolist(), strict=True)]


def _segments_meet(one: Float[np.ndarray, "m 2 2"], other: Float[np.ndarray, "m 2 2"]) -> Bool[np.ndarray, " m"]:
    """Returns whether segments in the plane have a common point."""
    (a, b), (c, d) = one.swapaxes(0, 1), other.swapaxes(0, 1)
    of_other, of_one = _sides(a, b, c) * _sides(a, b, d), _sides(c, d, a) * _sides(c, d, b)
    # Collinear segments meet exactly if their boxes meet; other segments can only meet if their boxes meet.
    boxes_meet = (one.min(axis=1) <= other.max(axis=1)) & (other.min(axis=1) <= one.max(axis=1))
    return (of_other <= 0) & (of_one <= 0) & boxes_meet.all(axis=1)


def _segments_meet_triangles(
    edges: Float[np.ndarray, "m 2 3"], triangles: Float[np.ndarray, "m 3 3"]
) -> Bool[np.ndarray, " m"]:
    """Returns whether segments in space meet triangles."""
    (p, q), (a, b, c) = edges.swapaxes(0, 1), triangles.swapaxes(0, 1)
    start, end = _sides(a, b, c, p), _sides(a, b, c, q)
    flat = (start == 0) & (end == 0)
    result = (start * end <= 0) & ~flat
    p, q, a, b, c = (points[result] for points in (p, q, a, b, c))
    around = np.stack([_sides(p, q, a, b), _sides(p, q, b, c), _sides(p, q, c, a)])
    result[result] = (around.min(axis=0) >= 0) | (around.max(axis=0) <= 0)
    result[flat] = _meet_in_plane(edges[flat], triangles[flat])
    return result


def _meet_in_plane(edges: np.ndarray, triangles: np.ndarray) -> Bool[np.ndarray, " m"]:
    """Returns whether segments in a triangle's plane meet it, projected along the largest component of its normal."""
    a, b, c = triangles.swapaxes(0, 1)
    axis = np.argmax(np.abs(np.cross(b - a, c - a)), axis=1)
    kept = np.array([[1, 2], [0, 2], [0, 1]])[axis][:, None, :]
    edges, triangles = (np.take_along_axis(points, kept, axis=2) for points in (edges, triangles))
    sides = np.stack([_sides(triangles[:, i], triangles[:, (i + 1) % 3], edges[:, 0]) for i in range(3)])
    result = (sides.min(axis=0) >= 0) | (sides.max(axis=0) <= 0)
    for i in range(3):
        result |= _segments_meet(edges, triangles[:, [i, (i + 1) % 3]])
    return result


def _sides(*points: Float[np.ndarray, "m dim"]) -> Int[np.ndarray, " m"]:
    """Returns the signs of the orientations of dim + 1 points."""
    rows = np.stack([point - points[0] for point in points[1:]], axis=1)
    value, size = _determinants(rows)
    signs = np.sign(value).astype(int)
    # Differences of equal coordinates are exactly zero, and so is a determinant of vanishing products.
    for number in np.flatnonzero((np.abs(value) <= _ROUNDING * size) & (size > 0)):
        first, *others = ([Fraction(float(u)) for u in point[number]] for point in points)
        exact, _ = _determinants(np.array([[np.subtract(other, first) for other in others]], dtype=object))
        signs[number] = (exact[0] > 0) - (exact[0] < 0)
    return signs


def _determinants(rows: np.ndarray) -> tuple[Any, Any]:
    """Returns determinants [m] of rows [m, dim, dim], and the sums of the absolute values of their products."""
    value, size = 0, 0
    for order in itertools.permutations(range(rows.shape[1])):
        product = rows[:, 0, order[0]]
        for row, column in enumerate(order[1:], start=1):
            product = product * rows[:, row, column]
        swaps = sum(i > j for i, j in itertools.combinations(order, 2))
        value, size = value + (-1) ** swaps * product, size + abs(product)
    return value, size


_MEET = {2: _segments_meet, 3: _segments_meet_triangles}
"""Test of an edge and a facet by dimension."""
