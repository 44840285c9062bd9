"""Broad phase: lists, of fixed capacity, of primitives that may come near each other.

Primitives are grouped once into clusters of neighbours in the rest shape, which stay neighbours while the body deforms.
The bounding boxes of clusters are compared first, then those of the primitives in clusters that meet. A list that is
too short is reported, never silently cut off.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

CLUSTER = 8
"""Number of primitives that share one bounding box."""


class Group(NamedTuple):
    """Primitives of one kind, in clusters."""

    primitives: Int[np.ndarray, "m k"]
    """Vertices of the primitives."""
    clusters: Int[np.ndarray, "c 8"]
    """Indices of the primitives in every cluster; -1 for an empty slot."""


class Boxes(NamedTuple):
    """Bounding boxes in m."""

    low: Float[Array, "*m dim"]
    high: Float[Array, "*m dim"]


class PairList(NamedTuple):
    """A list of pairs of primitives."""

    pairs: Int[Array, "capacity 2"]
    """Indices of the primitives."""
    used: Bool[Array, " capacity"]
    """False for unused slots."""
    overflow: Bool[Array, ""]
    """Whether there are more pairs than slots."""


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
    return Boxes(low.min(axis=1) - margin, high.max(axis=1) + margin)


def meeting(one: tuple[ArrayLike, ArrayLike], other: tuple[ArrayLike, ArrayLike]) -> Int[np.ndarray, "m 2"]:
    """Returns the pairs of known boxes (low, high) that meet, by rows of the first."""
    (low, high), (other_low, other_high) = (map(np.asarray, side) for side in (one, other))
    # Boxes that meet have centres no farther apart than the halves of the longest sides, and rounding.
    reach = (np.max(high - low) + np.max(other_high - other_low)) / 2 + 1e-12 * np.abs(other_high).max()
    trees = KDTree((low + high) / 2), KDTree((other_low + other_high) / 2)
    columns = trees[0].query_ball_tree(trees[1], reach, p=np.inf)
    row, column = np.repeat(np.arange(len(low)), list(map(len, columns))), np.concatenate(columns).astype(int)
    meet = (low[row] <= other_high[column]) & (other_low[column] <= high[row])
    return np.stack([row, column], axis=1)[meet.all(axis=1)]


def meetings(one: Group, other: Group, x: Float[np.ndarray, "n dim"], margin: float) -> tuple[int, int]:
    """Counts the pairs of clusters and of primitives whose boxes, each enlarged by half the margin, meet at x."""
    at = jnp.asarray(x)
    first, second = (boxes(of, at, at, margin / 2) for of in (one, other))
    return len(meeting(_of_clusters(one, first), _of_clusters(other, second))), len(meeting(first, second))


def pairs_near(one: Group, other: Group, of_one: Boxes, of_other: Boxes, capacity: tuple[int, int]) -> PairList:
    """Returns the pairs of primitives without a common vertex whose boxes meet.

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
    near = _meet(*(Boxes(*(side[number] for side in box)) for box, number in ((of_one, first), (of_other, second))))
    place, taken, too_many = places(near & present & ~shared, capacity[1])
    cluster, i, j = jnp.unravel_index(place, near.shape)
    return PairList(jnp.stack([first[cluster, i], second[cluster, j]], axis=1), taken, too_many | too_many_clusters)


def _of_clusters(of: Group, box: Boxes) -> Boxes:
    members, empty = jnp.asarray(of.clusters), (of.clusters < 0)[:, :, None]
    low = jnp.where(empty, jnp.inf, box.low[members]).min(axis=1)
    return Boxes(low, jnp.where(empty, -jnp.inf, box.high[members]).max(axis=1))


def _meet(one: Boxes, other: Boxes) -> Bool[Array, "*batch one other"]:
    """Whether boxes meet, for all pairs along their last batch axis."""

    def axis(i: int) -> Array:
        return (one.low[..., :, None, i] <= other.high[..., None, :, i]) & (
            other.low[..., None, :, i] <= one.high[..., :, None, i]
        )

    meets = axis(0)
    for i in range(1, one.low.shape[-1]):
        meets &= axis(i)
    return meets


def places(mask: Bool[Array, "..."], capacity: int) -> tuple[Int[Array, " capacity"], Bool[Array, " capacity"], Array]:
    """Returns the flat indices where the mask is true, which slots are used, and whether some had to be left out."""
    # Binary searches in the running counts of 32-bit words, then in a word: several times faster than `nonzero`.
    flat = mask.reshape(-1)
    rows = jnp.pad(flat, (0, -len(flat) % 32)).reshape(-1, 32)
    words = jnp.sum(rows.astype(jnp.uint32) << jnp.arange(32, dtype=jnp.uint32), axis=1, dtype=jnp.uint32)
    counts = jax.lax.population_count(words).astype(jnp.int32)
    running = jnp.cumsum(counts)
    number = jnp.arange(capacity, dtype=jnp.int32)
    used = number < running[-1]
    at = jnp.minimum(jnp.searchsorted(running, number, side="right"), len(words) - 1)
    word, rank, place = words[at], number - running[at] + counts[at], jnp.zeros(capacity, jnp.int32)
    for half in (16, 8, 4, 2, 1):
        low = jax.lax.population_count(word & jnp.uint32(2**half - 1)).astype(jnp.int32)
        beyond = rank >= low
        rank, place = rank - jnp.where(beyond, low, 0), place + jnp.where(beyond, half, 0)
        word = jnp.where(beyond, word >> half, word)
    return jnp.where(used, at * 32 + place, 0), used, running[-1] > capacity
