"""Cholesky factorisation of a sparse matrix, H = L Lᵀ, by square tiles after nested dissection.

A separator splits the graph of the matrix into two parts that do not touch. The parts are split in turn, and every
separator is eliminated after both of its parts (George 1973). Graph distances from a few distant vertices serve as
coordinates. The separator is the minimum cut (maximum flow, unit capacity per vertex) within a band around the middle
of the part's longest axes. The vertices of a separator are ordered along its own longest axes, so that a part touches
few of its tiles.

Only non-zero tiles of L are stored. They are computed column by column:

    L_jj L_jjᵀ = H_jj - sum over k < j of L_jk L_jkᵀ,    L_ij L_jjᵀ = H_ij - sum over k < j of L_ik L_jkᵀ

The plan holds the lengths of the loops, so one compiled body serves all tiles.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra, maximum_flow

from dln_jax.solvers.elements.assembly import Pattern
from dln_jax.solvers.elimination import cholesky, substitute

# Rows of a tile: a multiple of the 2 or 3 unknowns of a vertex.
TILE = 48
# Number of distant vertices for the coordinates, and number of axes to try.
_LANDMARKS = 12
_AXES = 2
# Smallest share of the vertices in a part; possible separators lie between the parts.
_SMALLEST_PART = 0.36

Numbers = Int[np.ndarray, " number"]
Points = Float[np.ndarray, "n landmarks"]
Tiles = Float[Array, "tiles size size"]


class Plan(NamedTuple):
    """Tables of the factorisation, made once from the sparsity pattern."""

    row: Numbers
    column: Numbers
    """Row and column of every tile, column after column with the diagonal first."""
    first: Numbers
    """For every tile and past the last, the first of its products."""
    left: Numbers
    right: Numbers
    """Tiles L_ik and L_jk of every product."""
    entries: Numbers
    """Places of the entries of the matrix in the tiles."""
    units: Numbers
    """Places of padding on the diagonal, where the matrix is the unit matrix."""
    places: Numbers
    """Place of every unknown in the order of elimination; past its end if the unknown is not eliminated."""


def plan(at: Pattern) -> Plan:
    """Returns the tables for the free unknowns of a pattern."""
    row, column = at.rows // at.width, at.columns // at.width
    coupled = csr_array(coo_array((np.ones(len(row)), (row, column)), shape=(at.blocks, at.blocks)))
    graph = csr_array(coupled + coupled.T)
    graph.setdiag(0)
    graph.eliminate_zeros()
    graph.data[:] = 1
    solved = np.flatnonzero(at.free.any(axis=1))
    unknowns = np.arange(at.unknowns).reshape(at.blocks, at.width)
    places, count, padding = np.full(at.unknowns, -1), 0, []
    for vertices in dissect(graph[solved][:, solved], max(1, TILE // at.width)):
        own = unknowns[solved[vertices]][at.free[solved[vertices]]]
        places[own] = count + np.arange(len(own))
        end = count + -(-len(own) // TILE) * TILE
        padding.append(np.arange(count + len(own), end))
        count = end
    later, earlier = np.sort([places[at.rows], places[at.columns]], axis=0)[::-1]
    number = _filled_tiles(later // TILE, earlier // TILE, count // TILE)
    column, row = np.nonzero(number.T >= 0)
    targets, lefts, rights = [], [], []
    for k in range(len(number)):
        below = k + 1 + np.flatnonzero(number[k + 1 :, k] >= 0)
        i, j = np.tril_indices(len(below))
        targets.append(number[below[i], below[j]])
        lefts.append(number[below[i], k])
        rights.append(number[below[j], k])
    target = np.concatenate(targets)
    order = np.argsort(target, kind="stable")
    # At least one product, because an empty table cannot be indexed.
    left, right = (np.append(np.concatenate(tiles)[order], 0) for tiles in (lefts, rights))

    def inside(i: Numbers, j: Numbers) -> Numbers:
        return (number[i // TILE, j // TILE] * TILE + i % TILE) * TILE + j % TILE

    units = np.concatenate(padding)
    first = np.searchsorted(target[order], np.arange(len(row) + 1))
    ends = np.where(places < 0, count, places)
    tables = Plan(row, column, first, left, right, inside(later, earlier), inside(units, units), ends)
    return Plan(*(table.astype(np.int32) for table in tables))


def _filled_tiles(row: Numbers, column: Numbers, count: int) -> Int[np.ndarray, "count count"]:
    """Returns the numbers of the tiles of L, column after column, and -1 for tiles that stay zero."""
    filled = np.eye(count, dtype=bool)
    filled[row, column] = True
    for k in range(count):
        below = k + 1 + np.flatnonzero(filled[k + 1 :, k])
        if len(below):
            filled[below, below[0]] = True
    number = np.full((count, count), -1, np.int32)
    number.T[filled.T] = np.arange(filled.sum())
    return number


def factorise(at: Plan, entries: Float[Array, " entries"]) -> Tiles:
    """Returns the tiles of L; not finite if the matrix is not positive definite."""
    row, column, first, left, right = map(jnp.asarray, at[:5])
    diagonal = jnp.asarray(np.flatnonzero(at.row == at.column))
    tiles = jnp.zeros(len(at.row) * TILE**2, entries.dtype)
    tiles = tiles.at[at.entries].set(entries, unique_indices=True, mode="promise_in_bounds")
    tiles = tiles.at[at.units].set(1, unique_indices=True, mode="promise_in_bounds").reshape(-1, TILE, TILE)

    def compute(number: Array, tiles: Tiles) -> Tiles:
        def subtract(product: Array, tile: Array) -> Array:
            return tile - _item(tiles, left[product]) @ _item(tiles, right[product]).T

        tile = lax.fori_loop(first[number], first[number + 1], subtract, _item(tiles, number))
        tile = lax.cond(
            row[number] == column[number],
            lambda _, tile: cholesky(tile),
            lambda lower, tile: substitute(lower, tile, transposed=True, right=True),
            _item(tiles, diagonal[column[number]]),
            tile,
        )
        return lax.dynamic_update_index_in_dim(tiles, tile, number, 0)

    return lax.fori_loop(0, len(at.row), compute, tiles)


def solve(at: Plan, factor: Tiles, b: Float[Array, " n"]) -> Float[Array, " n"]:
    """Returns x with L Lᵀ x = b; zero for unknowns that are not eliminated."""
    row, starts = jnp.asarray(at.row), np.flatnonzero(at.row == at.column)
    bounds, count = jnp.asarray(np.append(starts, len(at.row))), len(starts)
    x = jnp.zeros(count * TILE + 1, b.dtype).at[at.places].set(b)[:-1].reshape(count, TILE)

    def forwards(j: Array, x: Array) -> Array:
        y = substitute(_item(factor, bounds[j]), _item(x, j)[:, None])[:, 0]

        def below(number: Array, x: Array) -> Array:
            return x.at[row[number]].add(-_item(factor, number) @ y)

        return lax.fori_loop(bounds[j] + 1, bounds[j + 1], below, x.at[j].set(y))

    def backwards(step: Array, x: Array) -> Array:
        j = count - 1 - step

        def below(number: Array, right: Array) -> Array:
            return right - _item(x, row[number]) @ _item(factor, number)

        right = lax.fori_loop(bounds[j] + 1, bounds[j + 1], below, _item(x, j))
        return x.at[j].set(substitute(_item(factor, bounds[j]), right[:, None], transposed=True)[:, 0])

    x = lax.fori_loop(0, count, backwards, lax.fori_loop(0, count, forwards, x))
    return jnp.append(x, 0)[at.places]


def _item(array: Array, number: Array) -> Array:
    return lax.dynamic_index_in_dim(array, number, keepdims=False)


def dissect(graph: csr_array, tile: int) -> list[np.ndarray]:
    """Returns groups of vertices in order of elimination.

    Args:
        graph: symmetric, with positive entries off the diagonal and none on it.
        tile: number of vertices that fill a tile; parts of up to four tiles are not split.
    """
    groups: list[np.ndarray] = []

    def split(vertices: np.ndarray, points: Points) -> None:
        if len(vertices) <= 4 * tile:
            groups.append(_by_tiles(vertices, points, tile))
            return
        left, right, separator = bisect(graph[vertices][:, vertices], points)
        split(vertices[left], points[left])
        split(vertices[right], points[right])
        groups.append(_by_tiles(vertices[separator], points[separator], tile))

    _, body = connected_components(graph, directed=False)
    for number in range(body.max(initial=-1) + 1):
        vertices = np.flatnonzero(body == number)
        split(vertices, coordinates(graph[vertices][:, vertices]))
    return groups


def coordinates(graph: csr_array) -> Points:
    """Returns distances in a connected graph from a few distant vertices, averaged over neighbours."""
    start = breadth_first_order(graph, 0, directed=False, return_predecessors=False)[-1]
    distances = [dijkstra(graph, indices=start, unweighted=True)]
    for _ in range(_LANDMARKS - 1):
        farthest = np.argmax(np.min(distances, axis=0))
        distances.append(dijkstra(graph, indices=farthest, unweighted=True))
    points = np.stack(distances, axis=1)
    # Averaged, because many vertices have equal distances.
    degree = np.maximum(graph.sum(axis=1), 1)[:, None]
    for _ in range(2):
        points = (points + (graph @ points) / degree) / 2
    return points


def _along_axes(points: Points) -> Float[np.ndarray, "axes n"]:
    """Returns the points' places along their longest principal axes."""
    centred = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred.T @ centred)
    return axes[:_AXES] @ centred.T


def _by_tiles(vertices: np.ndarray, points: Points, tile: int) -> np.ndarray:
    """Returns vertices in an order that puts neighbours into one tile, by halving along the longest axis."""
    if len(vertices) <= tile:
        return vertices
    order = np.argsort(_along_axes(points)[0], kind="stable")
    half = -(-len(vertices) // tile) // 2 * tile
    halves = order[:half], order[half:]
    return np.concatenate([_by_tiles(vertices[part], points[part], tile) for part in halves])


def bisect(graph: csr_array, points: Points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the vertices of two parts that do not touch, and of the separator between them."""
    count = len(points)
    low, high = int(_SMALLEST_PART * count), int(np.ceil((1 - _SMALLEST_PART) * count))
    orders = [np.argsort(along, kind="stable") for along in _along_axes(points)]

    def work(parts: tuple[np.ndarray, np.ndarray, np.ndarray]) -> float:
        left, right, separator = map(len, parts)
        return separator * (1 + 2 * ((left - right) / count) ** 2)

    return min((_smallest_separator(graph, order[:low], order[high:]) for order in orders), key=work)


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
