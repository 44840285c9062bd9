"""Counts overlapping components of a moving mesh by separating-axis tests of simplices, after bounding boxes.

Two convex bodies have common interior points exactly if their projections overlap on every candidate axis (Gottschalk,
Lin and Manocha 1996): the facet normals of both bodies and, in space, the cross products of their edges.
"""

import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dln_jax.softbody.mesh.mesh import Mesh, components
from dln_jax.softbody.mesh.simplices import FACETS

_CLUSTER = 16
"""Number of elements that share one bounding box."""


def count_overlaps(mesh: Mesh) -> Callable[[Float[Array, "n dim"]], Int[Array, ""]] | None:
    """Returns positions -> number of overlapping pairs of components; `None` for a mesh of one component.

    Components that only touch, to a depth of sqrt(eps) of the larger element, do not overlap. Elements are compared
    only if the bounding boxes of their clusters meet.
    """
    labels = components(mesh)
    if labels.max(initial=0) == 0:
        return None
    clusters, owners = _clusters(mesh, labels)
    one, other = np.nonzero(np.triu(owners[:, None] != owners[None, :]))
    pairs = owners[np.stack([one, other])]
    distinct, pair_of = np.unique(np.sort(pairs, axis=0), axis=1, return_inverse=True)
    pair_of, count = jnp.asarray(pair_of.reshape(-1)), distinct.shape[1]
    one, other, corners = jnp.asarray(one), jnp.asarray(other), jnp.asarray(mesh.elements[clusters])

    def overlapping(x: Float[Array, "n dim"]) -> Int[Array, ""]:
        low, high = (extreme(x[corners], axis=(1, 2)) for extreme in (jnp.min, jnp.max))
        near = ((low[one] < high[other]) & (low[other] < high[one])).all(axis=1)
        places = jnp.nonzero(near, size=len(one), fill_value=0)[0]

        def look(state: tuple[Array, Array]) -> tuple[Array, Array]:
            k, hits = state
            place = places[k]
            pair = pair_of[place]

            def meet(_: None) -> Array:
                of_one, of_other = x[corners[one[place]]], x[corners[other[place]]]
                return jax.vmap(lambda a: jax.vmap(lambda b: simplices_overlap(a, b))(of_other))(of_one).any()

            # One overlapping pair of elements is enough for its pair of components.
            hit = jax.lax.cond(hits[pair], lambda _: jnp.asarray(True), meet, None)
            return k + 1, hits.at[pair].max(hit)

        start = jnp.asarray(0), jnp.zeros(count, bool)
        return jax.lax.while_loop(lambda state: state[0] < near.sum(), look, start)[1].sum()

    return overlapping


def simplices_overlap(a: Float[Array, "corners dim"], b: Float[Array, "corners dim"]) -> Array:
    """Whether two triangles or tetrahedra have common interior points."""
    axes = jnp.concatenate([_normals(a), _normals(b), *([_edge_products(a, b)] if a.shape[1] == 3 else [])])
    squared = jnp.sum(axes**2, axis=1)
    extent = jnp.maximum(*(jnp.max(corners.max(axis=0) - corners.min(axis=0)) for corners in (a, b)))
    # The cross product of parallel edges is zero and gives no axis.
    scale = extent if a.shape[1] == 2 else extent**2
    usable = squared > (jnp.sqrt(jnp.finfo(a.dtype).eps) * scale) ** 2
    # Coordinates relative to a nearby origin, so that a large distance from the world's origin costs no precision.
    of_a, of_b = ((corners - a[0]) @ axes.T for corners in (a, b))
    depth = jnp.minimum(of_a.max(axis=0) - of_b.min(axis=0), of_b.max(axis=0) - of_a.min(axis=0))
    depth = jnp.where(usable, depth / jnp.sqrt(jnp.where(usable, squared, 1.0)), jnp.inf)
    return depth.min() > jnp.sqrt(jnp.finfo(a.dtype).eps) * extent


def _normals(corners: Float[Array, "corners dim"]) -> Float[Array, "facets dim"]:
    facets = corners[np.array(FACETS[corners.shape[1]])]
    along = facets[:, 1] - facets[:, 0]
    if corners.shape[1] == 2:
        return jnp.stack([-along[:, 1], along[:, 0]], axis=1)
    return jnp.cross(along, facets[:, 2] - facets[:, 0])


def _edge_products(a: Float[Array, "4 3"], b: Float[Array, "4 3"]) -> Float[Array, "36 3"]:
    first, second = np.array(list(itertools.combinations(range(4), 2))).T
    edges = [corners[second] - corners[first] for corners in (a, b)]
    return jnp.cross(edges[0][:, None], edges[1][None, :]).reshape(-1, 3)


def _clusters(
    mesh: Mesh, labels: Int[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, "clusters size"], Int[np.ndarray, " clusters"]]:
    """Returns clusters of neighbouring elements of one component, and their components; short ones repeat elements."""
    centres = mesh.vertices[mesh.elements].mean(axis=1)
    clusters, owners = [], []

    def split(members: np.ndarray, label: int) -> None:
        if len(members) <= _CLUSTER:
            clusters.append(np.resize(members, _CLUSTER))
            owners.append(label)
            return
        axis = np.argmax(np.ptp(centres[members], axis=0))
        ordered = members[np.argsort(centres[members, axis], kind="stable")]
        half = _CLUSTER * (-(-len(members) // _CLUSTER) // 2)
        split(ordered[:half], label)
        split(ordered[half:], label)

    for label in range(labels.max() + 1):
        split(np.flatnonzero(labels == label), label)
    return np.array(clusters), np.array(owners)
