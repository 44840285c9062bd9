"""Facets of bodies: parts of the surface, facets of named sets, closed surfaces of chambers and enclosed volumes.

Facets [f, dim] are edges in the plane or triangles in space, by their corners. A chamber is bounded by a closed surface
of facets between any vertices: the wall of a cavity, and caps over its openings. Its facets are oriented out of the
chamber, into the material, so that the enclosed volume

    plane:  sum over edges of ½ (a x b)        space:  sum over triangles of 1/6 a·(b x c)

is positive. It does not depend on the origin.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from dln_jax.softbody.mesh.mesh import Mesh, boundary, vertices_in
from dln_jax.softbody.mesh.simplices import SIDES, AnyArray, connected, determinant, facet_rule
from dln_jax.types import InputError

RIDGES = {2: "vertex", 3: "edge"}


def surface_parts(mesh: Mesh) -> list[Int[np.ndarray, "f dim"]]:
    """Returns connected parts of the boundary, oriented out of the body: outer surfaces, then walls of cavities.

    Parts are sorted by the signed volume that they enclose, which is negative for a cavity.
    """
    outside = boundary(mesh)
    ridges, _ = _ridges(outside)
    _, number = np.unique(ridges.reshape(-1, mesh.dimension - 1), axis=0, return_inverse=True)
    label = connected(number.reshape(len(outside), -1))
    parts = [outside[label == part] for part in range(label.max() + 1)]
    return sorted(parts, key=lambda part: -float(enclosed_volume(mesh.vertices, part)))


def inner_surface(mesh: Mesh) -> Int[np.ndarray, "f dim"]:
    """Returns the walls of all closed cavities of a body, for `pressure`.

    Raises:
        InputError: the body has no closed cavity.
    """
    walls = [part for part in surface_parts(mesh) if enclosed_volume(mesh.vertices, part) < 0]
    if not walls:
        raise InputError("the body has no closed cavity; name the facets of the chamber, and cap its openings")
    return np.concatenate(walls)


def facets_in(mesh: Mesh, name: str) -> Int[np.ndarray, "f dim"]:
    """Returns the boundary facets with all corners in a named set.

    Raises:
        InputError: the set does not exist, or contains no facet of the boundary.
    """
    outside = boundary(mesh)
    chosen = outside[np.isin(outside, vertices_in(mesh, [name])).all(axis=1)]
    if not len(chosen):
        what = {2: "edge", 3: "triangle"}[mesh.dimension]
        raise InputError(f"the set '{name}' contains no {what} of the surface; expected a set that covers part of it")
    return chosen


def closed_surface(mesh: Mesh, facets: ArrayLike, *, cap: bool = False) -> Int[np.ndarray, "f dim"]:
    """Returns the facets of a chamber, oriented out of it.

    Boundary facets of the body are oriented into its material; other facets, such as caps, are oriented like their
    neighbours. A part without boundary facets is oriented to enclose a positive volume.

    Args:
        facets: [f, dim] vertices, in any orientation and order.
        cap: close openings with flat facets between the vertices of their rims; in the plane, one opening at most.

    Raises:
        InputError: facets are repeated or do not fit the mesh, or the surface is open; the message locates the gap.
    """
    chosen = _oriented(mesh, checked_facets(mesh, facets))
    if cap:
        chosen = np.concatenate([chosen, _caps(chosen)])
    if len(gaps := _open_ridges(chosen)):
        place, kind = gaps[0].tolist(), RIDGES[mesh.dimension]
        at = np.round(mesh.vertices[gaps[0]].mean(axis=0), 6).tolist()
        name = place[0] if mesh.dimension == 2 else place
        capped = "pass cap=True" if mesh.midsides is None else "use linear elements (order 1), whose openings have caps"
        raise InputError(
            f"the surface is open at {len(gaps)} {'vertices' if mesh.dimension == 2 else 'edges'}, the first is {kind} "
            f"{name} near {at} m; add the facets that close it, or {capped}"
        )
    return chosen


def checked_facets(mesh: Mesh, facets: ArrayLike) -> Int[np.ndarray, "f dim"]:
    """Returns facets as integers [f, dim]; refuses facets that are repeated or do not fit the mesh."""
    chosen = np.asarray(facets)
    if chosen.ndim != 2 or chosen.shape[1] != mesh.dimension or not len(chosen) or chosen.dtype.kind not in "iu":
        raise InputError(
            f"facets are {chosen.dtype} of shape {list(chosen.shape)}; expected integers [f, {mesh.dimension}], f >= 1"
        )
    chosen, n = chosen.astype(np.int64), len(mesh.vertices)
    ordered = np.sort(chosen, axis=1)
    wrong = (chosen < 0).any(axis=1) | (chosen >= n).any(axis=1) | (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
    if wrong.any():
        bad = int(np.argmax(wrong))
        raise InputError(
            f"facet {bad} is {chosen[bad].tolist()}; expected {mesh.dimension} different vertices of 0..{n - 1}"
        )
    _, first, count = np.unique(ordered, axis=0, return_index=True, return_counts=True)
    if (count > 1).any():
        raise InputError(f"facet {chosen[first[np.argmax(count > 1)]].tolist()} is repeated; name it once")
    return chosen


def facet_nodes(mesh: Mesh, facets: Int[np.ndarray, "f dim"]) -> Int[np.ndarray, "f nodes"]:
    """Returns the corners of facets, followed in a quadratic mesh by mid-side nodes in the order of `facet_rule`.

    Raises:
        InputError: a facet of a quadratic mesh has an edge without a mid-side node, such as a cap.
    """
    if mesh.midsides is None:
        return facets
    sides = np.array([[0, 1]] if mesh.dimension == 2 else SIDES[2])
    edges = np.sort(mesh.elements[:, np.array(SIDES[mesh.dimension])].reshape(-1, 2), axis=1)
    middles = dict(zip(map(tuple, edges.tolist()), mesh.midsides.ravel().tolist(), strict=True))
    wanted = np.sort(facets[:, sides], axis=2).tolist()
    try:
        nodes = [[middles[tuple(edge)] for edge in of_facet] for of_facet in wanted]
    except KeyError as error:
        raise InputError(
            f"edge {list(error.args[0])} of a facet is not in the quadratic mesh; only linear meshes can have caps"
        ) from None
    return np.append(facets, nodes, axis=1)


def enclosed_volume(x: Float[AnyArray, "n dim"], nodes: Int[np.ndarray, "f nodes"]) -> Any:
    """Returns the volume in m³ (area in m²) that facets with these nodes enclose at x in m (NumPy or JAX array)."""
    dimension = x.shape[1]
    if nodes.shape[1] == dimension:
        return determinant(x[nodes].transpose(1, 2, 0)).sum() / math.factorial(dimension)
    points, normals = facet_points(x[nodes])
    return (points * normals).sum() / dimension


def facet_points(
    nodes: Float[AnyArray, "f nodes dim"],
) -> tuple[Float[AnyArray, "f points dim"], Float[AnyArray, "f points dim"]]:
    """Returns quadrature points of facets in m, and normals with the points' shares of the area as lengths, in m²."""
    values, slopes, weights = facet_rule(nodes.shape[2], nodes.shape[1] > nodes.shape[2])
    points = (nodes.swapaxes(1, 2)[:, None] @ values[:, :, None])[..., 0]
    tangents = nodes.swapaxes(1, 2)[:, None] @ slopes
    if nodes.shape[2] == 2:
        return points, (tangents[..., 0] @ np.array([[0.0, -1.0], [1.0, 0.0]])) * weights[:, None]
    one, other = tangents[..., 0], tangents[..., 1]
    ahead, behind = [1, 2, 0], [2, 0, 1]
    normals = one[..., ahead] * other[..., behind] - one[..., behind] * other[..., ahead]
    return points, normals * weights[:, None]


def _ridges(facets: Int[np.ndarray, "f dim"]) -> tuple[Int[np.ndarray, "f dim d"], Int[np.ndarray, "f dim"]]:
    """Returns the ends or edges of facets, with sorted vertices, and their direction (±1) in each facet."""
    if facets.shape[1] == 2:
        return facets[:, :, None], np.broadcast_to([-1, 1], facets.shape)
    ends = facets[:, np.array(SIDES[2])]
    return np.sort(ends, axis=2), np.where(ends[:, :, 0] < ends[:, :, 1], 1, -1)


def _open_ridges(facets: Int[np.ndarray, "f dim"]) -> Int[np.ndarray, "g d"]:
    """Returns the unbalanced ridges, used more often in one direction, in this direction."""
    ridges, signs = _ridges(facets)
    distinct, number = np.unique(ridges.reshape(-1, ridges.shape[2]), axis=0, return_inverse=True)
    net = np.bincount(number.reshape(-1), weights=signs.ravel()).astype(int)
    gaps = distinct[net != 0]
    if gaps.shape[1] == 2:
        return np.where(net[net != 0, None] < 0, gaps[:, ::-1], gaps)
    # Start points come first.
    return gaps[np.argsort(net[net != 0], kind="stable")]


def _oriented(mesh: Mesh, facets: Int[np.ndarray, "f dim"]) -> Int[np.ndarray, "f dim"]:
    """Orients boundary facets into the body, and other facets like their neighbours."""
    outside = {frozenset(facet): facet for facet in boundary(mesh).tolist()}
    inward = [outside.get(frozenset(facet), [])[::-1] for facet in facets.tolist()]
    owners: dict[tuple, list[int]] = {}
    for facet, ridges in enumerate(_ridges(facets)[0].tolist()):
        for ridge in ridges:
            owners.setdefault(tuple(ridge), []).append(facet)
    turned = {facet: known for facet, known in enumerate(inward) if known}
    for start in sorted(range(len(facets)), key=lambda facet: not inward[facet]):
        if start in turned and not inward[start]:
            continue
        turned.setdefault(start, facets[start].tolist())
        part = [start]
        for facet in part:  # which grows by its neighbours
            for ridge, sign in _passages(turned[facet]):
                both = owners[ridge]
                for other in both if len(both) == 2 else ():
                    if other not in turned:
                        same = (ridge, -sign) in _passages(facets[other])
                        turned[other] = facets[other].tolist()[:: 1 if same else -1]
                        part.append(other)
        if not inward[start] and enclosed_volume(mesh.vertices, np.array([turned[i] for i in part])) < 0:
            turned |= {i: turned[i][::-1] for i in part}
    return np.array([turned[number] for number in range(len(facets))])


def _passages(facet: Any) -> list[tuple[tuple[int, ...], int]]:
    """Returns the ridges of one facet, each with its direction."""
    ridges, signs = _ridges(np.array([facet]))
    return [(tuple(ridge), sign) for ridge, sign in zip(ridges[0].tolist(), signs[0].tolist(), strict=True)]


def _caps(facets: Int[np.ndarray, "f dim"]) -> Int[np.ndarray, "c dim"]:
    """Returns facets that close all openings: an edge in the plane, fans of triangles over the rims in space."""
    gaps = _open_ridges(facets)
    if facets.shape[1] == 2:
        if len(gaps) > 2:
            raise InputError(f"the surface has {len(gaps)} open ends; expected 2: add the edges that join them")
        return gaps[::-1].reshape(-1, 2)
    following = dict(gaps[:, ::-1].tolist())
    if len(following) < len(gaps):
        raise InputError("the rims of two openings meet in a vertex; add the triangles that close them")
    fans = []
    while following:
        start, at = following.popitem()
        while (after := following.pop(at)) != start:
            fans.append([start, at, after])
            at = after
    return np.array(fans, dtype=np.int64).reshape(-1, 3)
