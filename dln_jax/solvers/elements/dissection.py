"""Nested dissection: an elimination order with little fill for a sparse symmetric matrix, from its graph alone.

A separator splits the graph into two parts that do not touch; the parts are split in turn, and every separator is
eliminated after the parts on both its sides (George 1973). Breadth-first distances from a few distant vertices serve as
coordinates. Across the longest axis of these coordinates, the smallest separator within a band around the middle is a
minimum cut (maximum flow) with unit capacity per vertex.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra, maximum_flow

# Number of distant vertices whose distances are the coordinates, and of coordinate axes that are tried.
_LANDMARKS = 6
_AXES = 2
# Smallest share of the vertices that a part keeps; the band of possible separators lies between the parts.
_SMALLEST_PART = 0.36


class Node(NamedTuple):
    """Vertices that are eliminated together, and those affected by it."""

    own: Int[np.ndarray, " s"]
    boundary: Int[np.ndarray, " r"]
    """Neighbours that are eliminated later, in order of elimination."""
    children: tuple[int, ...]
    """Nodes eliminated earlier, whose boundaries lie in `own` and `boundary`."""


def dissect(graph: csr_array, leaf: int) -> list[Node]:
    """Returns the nodes of the elimination tree, children before their parents.

    Args:
        graph: symmetric, with positive entries off the diagonal and none on it.
        leaf: parts with at most this many vertices are not split.
    """
    nodes: list[Node] = []
    place = np.empty(len(graph.indptr) - 1, int)
    count = 0

    def eliminate(vertices: np.ndarray, children: tuple[int, ...]) -> int:
        nonlocal count
        place[vertices] = count + np.arange(len(vertices))
        count += len(vertices)
        nodes.append(Node(vertices, np.empty(0, int), children))
        return len(nodes) - 1

    def split(vertices: np.ndarray) -> tuple[int, ...]:
        if len(vertices) <= leaf:
            return (eliminate(vertices, ()),) if len(vertices) else ()
        left, right, separator = (vertices[part] for part in bisect(graph[vertices][:, vertices]))
        children = (*split(left), *split(right))
        return (eliminate(separator, children),) if len(separator) else children

    split(np.arange(len(graph.indptr) - 1))
    for number, (own, _, children) in enumerate(nodes):
        near = np.concatenate([graph[own].indices, *(nodes[child].boundary for child in children)])
        later = np.unique(near[place[near] > place[own].max()])
        nodes[number] = nodes[number]._replace(boundary=later[np.argsort(place[later])])
    return nodes


def bisect(graph: csr_array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the vertices of two parts that do not touch, and of the separator between them."""
    parts, of_part = connected_components(graph, directed=False)
    if parts > 1:
        sizes = np.bincount(of_part)
        order = np.argsort(-sizes)
        left = np.cumsum(sizes[order]) <= max(sizes.max(), len(of_part) // 2)
        inside = np.isin(of_part, order[left])
        return np.flatnonzero(inside), np.flatnonzero(~inside), np.empty(0, int)
    return min(_separations(graph), key=lambda parts: _work(*map(len, parts)))


def _work(left: int, right: int, separator: int) -> float:
    """Rates separators: the cost of their own elimination, plus that of unbalanced parts."""
    return separator * (1 + 2 * ((left - right) / (left + right + separator)) ** 2)


def _separations(graph: csr_array) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    count = len(graph.indptr) - 1
    low, high = int(_SMALLEST_PART * count), int(np.ceil((1 - _SMALLEST_PART) * count))
    for along in _coordinates(graph).T:
        order = np.argsort(along, kind="stable")
        yield _smallest_separator(graph, order[:low], order[high:])


def _coordinates(graph: csr_array) -> Float[np.ndarray, "n axes"]:
    """Returns the longest principal axes of the distances from distant vertices."""
    start = breadth_first_order(graph, 0, directed=False, return_predecessors=False)[-1]
    distances = [dijkstra(graph, indices=start, unweighted=True)]
    for _ in range(_LANDMARKS - 1):
        farthest = np.argmax(np.min(distances, axis=0))
        distances.append(dijkstra(graph, indices=farthest, unweighted=True))
    points = np.stack(distances, axis=1)
    # Averaged over neighbours, because many vertices have equal distances.
    degree = graph.sum(axis=1)[:, None]
    for _ in range(2):
        points = (points + (graph @ points) / degree) / 2
    centred = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred.T @ centred)
    return centred @ axes[:_AXES].T


def _smallest_separator(
    graph: csr_array, left: np.ndarray, right: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the parts that contain `left` and `right`, and a smallest vertex separator between them.

    A vertex v is an edge of capacity one from node v to node n + v; it is cut if only its first end is reached.
    """
    count = len(graph.indptr) - 1
    source, sink, vertices = 2 * count, 2 * count + 1, np.arange(count)
    row, column = graph.nonzero()
    unlimited = count + 1
    ends = [
        (vertices, count + vertices, 1),
        (count + row, column, unlimited),
        (np.full(len(left), source), left, unlimited),
        (count + right, np.full(len(right), sink), unlimited),
    ]
    rows, columns = (np.concatenate([end[i] for end in ends]) for i in range(2))
    capacity = np.concatenate([np.full(len(end[0]), end[2]) for end in ends]).astype(np.int32)
    network = csr_array(coo_array((capacity, (rows, columns)), shape=(2 * count + 2,) * 2))
    left_over = csr_array(network - maximum_flow(network, source, sink).flow)
    left_over.data = np.maximum(left_over.data, 0)
    left_over.eliminate_zeros()
    reached = np.zeros(2 * count + 2, bool)
    reached[breadth_first_order(left_over, source, return_predecessors=False)] = True
    inside, outside = reached[count : 2 * count], ~reached[:count]
    return np.flatnonzero(inside), np.flatnonzero(outside), np.flatnonzero(~inside & ~outside)
