"""The contact surface of a body, and lists of fixed capacity for primitives near each other.

The facets of a quadratic mesh are divided at their mid-side nodes, into 2 edges in the plane and 4 triangles in space,
so all nodes are in contact, on a surface that is linear between them.

Primitives are grouped once into clusters of neighbours in the rest shape; they stay neighbours as the body deforms. The
bounding boxes of clusters are compared first, then the boxes of primitives in clusters that meet. A list that is too
short is reported, never silently truncated.
"""

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from dln_jax.softbody.mesh.mesh import Mesh, boundary
from dln_jax.softbody.mesh.surfaces import facet_nodes

CLUSTER = 8
"""Number of primitives in one bounding box."""
Boxes = tuple[Float[Array, "... dim"], Float[Array, "... dim"]]
"""Lowest and highest corners of bounding boxes, in m."""
_PARTS = {3: ((0, 2), (2, 1)), 6: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))}
"""Parts of a quadratic facet by its number of nodes, with the facet's orientation."""


class Surface(NamedTuple):
    """Primitives of the boundary, as vertex indices."""

    vertices: Int[np.ndarray, " v"]
    edges: Int[np.ndarray, "e 2"]
    facets: Int[np.ndarray, "f dim"]
    """The edges in the plane, triangles in space."""
    sides: Int[np.ndarray, "f 3"] | None
    """Edges of every triangle; `None` in the plane."""


class Group(NamedTuple):
    """Primitives of one kind, in clusters."""

    primitives: Int[np.ndarray, "m k"]
    """Vertices of the primitives."""
    clusters: Int[np.ndarray, "c 8"]
    """Indices of the primitives in every cluster; -1 for an empty slot."""


def surface_of(mesh: Mesh) -> Surface:
    """Returns the boundary of a mesh."""
    facets = boundary(mesh)
    if mesh.midsides is not None:
        nodes = facet_nodes(mesh, facets)
        facets = nodes[:, np.array(_PARTS[nodes.shape[1]])].reshape(-1, mesh.dimension)
    if mesh.dimension == 2:
        edges = np.sort(facets, axis=1)
        return Surface(np.unique(facets), edges, edges, None)
    pairs = np.sort(facets[:, list(itertools.combinations(range(3), 2))], axis=2)
    edges, sides = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    return Surface(np.unique(facets), edges, facets, sides.reshape(-1, 3))


def areas(surface: Surface, rest: Float[Array, "n dim"]) -> tuple[Float[Array, " v"], Float[Array, " e"]]:
    """Returns the areas of vertices and edges in m²: each gets a third of the areas of its triangles.

    In the plane, for a thickness of 1 m, a vertex gets half the lengths of its edges and an edge its length.
    """
    first, second, *third = (rest[corner] for corner in surface.facets.T)
    if third:
        share = jnp.linalg.norm(jnp.cross(second - first, third[0] - first), axis=1) / 6
        of_edges = jnp.zeros(len(surface.edges), rest.dtype).at[surface.sides].add(share[:, None])
    else:
        of_edges = jnp.linalg.norm(second - first, axis=1)
        share = of_edges / 2
    return jnp.zeros(len(rest), rest.dtype).at[surface.facets].add(share[:, None])[surface.vertices], of_edges


def group(primitives: Int[np.ndarray, "m k"], rest: Float[np.ndarray, "n dim"]) -> Group:
    """Groups primitives into clusters of neighbours, by halving along the longest side."""
    centres = rest[primitives].mean(axis=1)
    clusters: list[np.ndarray] = []

    def split(members: np.ndarray) -> None:
        if len(members) <= CLUSTER:
            clusters.append(np.pad(members, (0, CLUSTER - len(members)), constant_values=-1))
            return
        ordered = members[np.argsort(centres[members, np.argmax(np.ptp(centres[members], axis=0))], kind="stable")]
        half = CLUSTER * (-(-len(members) // CLUSTER) // 2)
        split(ordered[:half])
        split(ordered[half:])

    split(np.arange(len(primitives)))
    return Group(primitives, np.stack(clusters))


def boxes(of: Group, x: Float[Array, "n dim"], end: Float[Array, "n dim"], margin: Array | float) -> Boxes:
    """Returns the boxes that primitives sweep from x to `end`, enlarged by a margin in m."""
    low, high = jnp.minimum(x, end)[of.primitives], jnp.maximum(x, end)[of.primitives]
    return low.min(axis=1) - margin, high.max(axis=1) + margin


def meeting(one: tuple[ArrayLike, ArrayLike], other: tuple[ArrayLike, ArrayLike]) -> Int[np.ndarray, "m 2"]:
    """Returns the pairs of known boxes (low, high) that meet, by rows of the first."""
    (low, high), (other_low, other_high) = (map(np.asarray, side) for side in (one, other))
    # The centres of boxes that meet are at most half of both longest sides apart, plus rounding.
    reach = (np.max(high - low) + np.max(other_high - other_low)) / 2 + 1e-12 * np.abs(other_high).max()
    trees = KDTree((low + high) / 2), KDTree((other_low + other_high) / 2)
    columns = trees[0].query_ball_tree(trees[1], reach, p=np.inf)
    row, column = np.repeat(np.arange(len(low)), list(map(len, columns))), np.concatenate(columns).astype(int)
    meet = (low[row] <= other_high[column]) & (other_low[column] <= high[row])
    return np.stack([row, column], axis=1)[meet.all(axis=1)]


def meetings(one: Group, other: Group, x: Float[np.ndarray, "n dim"], margin: float) -> tuple[int, int]:
    """Counts the cluster pairs and primitive pairs with boxes, each enlarged by half the margin, that meet at x."""
    at = jnp.asarray(x)
    first, second = (boxes(of, at, at, margin / 2) for of in (one, other))
    return len(meeting(_of_clusters(one, first), _of_clusters(other, second))), len(meeting(first, second))


def pairs_near(
    one: Group, other: Group, of_one: Boxes, of_other: Boxes, capacity: tuple[int, int]
) -> tuple[Int[Array, "capacity 2"], Bool[Array, " capacity"], Bool[Array, ""]]:
    """Returns pairs of primitives with meeting boxes and no common vertex, the mask of used slots, and overflow.

    Args:
        one, other: the primitives; pairs within one group are listed once.
        of_one, of_other: their boxes.
        capacity: slots for pairs of clusters and for pairs of primitives.
    """
    same = one is other
    clusters, used, too_many_clusters = places(
        _meet(_of_clusters(one, of_one), _of_clusters(other, of_other))
        & (jnp.asarray(np.triu(np.ones((len(one.clusters), len(other.clusters)), bool))) if same else True),
        capacity[0],
    )
    row, column = jnp.divmod(clusters, len(other.clusters))
    first, second = jnp.asarray(one.clusters)[row], jnp.asarray(other.clusters)[column]
    present = used[:, None, None] & (first >= 0)[:, :, None] & (second >= 0)[:, None, :]
    if same:
        present &= (row != column)[:, None, None] | (first[:, :, None] < second[:, None, :])
    corners, others = jnp.asarray(one.primitives)[first], jnp.asarray(other.primitives)[second]
    shared = (corners[:, :, None, :, None] == others[:, None, :, None, :]).any(axis=(3, 4))
    near = _meet((of_one[0][first], of_one[1][first]), (of_other[0][second], of_other[1][second]))
    place, taken, too_many = places(near & present & ~shared, capacity[1])
    cluster, i, j = jnp.unravel_index(place, near.shape)
    return jnp.stack([first[cluster, i], second[cluster, j]], axis=1), taken, too_many | too_many_clusters


def _of_clusters(of: Group, box: Boxes) -> Boxes:
    members, empty = jnp.asarray(of.clusters), (of.clusters < 0)[:, :, None]
    low = jnp.where(empty, jnp.inf, box[0][members]).min(axis=1)
    return low, jnp.where(empty, -jnp.inf, box[1][members]).max(axis=1)


def _meet(one: Boxes, other: Boxes) -> Bool[Array, "*batch one other"]:
    """Returns whether boxes meet, for all pairs along their last batch axis."""
    (low, high), (other_low, other_high) = one, other
    axes = range(low.shape[-1])
    before = [low[..., :, None, i] <= other_high[..., None, :, i] for i in axes]
    after = [other_low[..., None, :, i] <= high[..., :, None, i] for i in axes]
    return functools.reduce(jnp.logical_and, before + after)


def places(mask: Bool[Array, "..."], capacity: int) -> tuple[Int[Array, " capacity"], Bool[Array, " capacity"], Array]:
    """Returns the flat indices where the mask is true, the mask of used slots, and whether indices are missing."""
    # A binary search in the running counts of 32-bit words: several times faster than `nonzero`.
    flat = mask.reshape(-1)
    rows = jnp.pad(flat, (0, -len(flat) % 32)).reshape(-1, 32)
    words = jnp.sum(rows.astype(jnp.uint32) << jnp.arange(32, dtype=jnp.uint32), axis=1, dtype=jnp.uint32)
    counts = jax.lax.population_count(words).astype(jnp.int32)
    running = jnp.cumsum(counts)
    number = jnp.arange(capacity, dtype=jnp.int32)
    used = number < running[-1]
    at = jnp.minimum(jnp.searchsorted(running, number, side="right"), len(words) - 1)
    # The place in a word is the number of prefixes with no more bits than the rank.
    beginnings = words[at, None] & jnp.asarray(2 ** np.arange(1, 33) - 1, jnp.uint32)
    rank = number - running[at] + counts[at]
    held = jax.lax.population_count(beginnings).astype(jnp.int32)
    place = jnp.sum(held <= rank[:, None], axis=1, dtype=jnp.int32)
    return jnp.where(used, at * 32 + place, 0), used, running[-1] > capacity
