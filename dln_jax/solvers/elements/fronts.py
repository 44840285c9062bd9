"""Index tables of a multifrontal Cholesky factorisation, made once from the sparsity pattern.

Every node of the elimination tree has a front: a dense matrix over the unknowns that it eliminates and over its
boundary, the unknowns that this affects. Fronts of any size consist of square tiles of one size, so that few operations
are compiled. Only tiles of the lower triangle are stored:

    L    tiles of the eliminated columns, row after row of each front; they are kept
    U    tiles of the boundary, which the parent adds to its own front; later fronts reuse their storage
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from dln_jax.solvers.elements.dissection import Node

Numbers = Int[np.ndarray, " number"]


class Steps(NamedTuple):
    """Columns of tiles to eliminate and, after those of a front, the tiles that it leaves for its parent."""

    first_target: Numbers
    last_target: Numbers
    """Range of the tiles to compute; `last` is past the end here and below."""
    columns: Numbers
    """1 for a column to eliminate, else 0."""
    diagonal: Numbers
    first_below: Numbers
    last_below: Numbers
    """Range of the tiles below it."""
    place: Numbers
    """Place of the column's first unknown in the order of elimination."""


class Targets(NamedTuple):
    """Tiles to compute: entries of the matrix plus parts from the children, minus products of tiles of L."""

    tile: Numbers
    kept: Numbers
    """1 for tiles of L, which start from entries of the matrix; 0 for tiles of U, which start from zero."""
    left: Numbers
    right: Numbers
    """First tiles of the rows of L to multiply."""
    products: Numbers
    first_part: Numbers
    last_part: Numbers


class Parts(NamedTuple):
    """Rows and columns of a child's U that are added to a tile: consecutive ones, in two by two tiles at most."""

    upper: Numbers
    lower: Numbers
    """First of the two tiles that hold the upper rows, and the lower rows."""
    first_row: Numbers
    first_column: Numbers
    """Number of the first row and column of these tiles in U."""
    rows: Numbers
    columns: Numbers
    """First of the target's rows and columns in `child_rows`."""


class Plan(NamedTuple):
    """Tables of the factorisation."""

    size: int
    """Rows and columns of a tile."""
    tiles: int
    """Number of stored tiles."""
    steps: Steps
    targets: Targets
    parts: Parts
    child_rows: Numbers
    """For every row of a parent's front, the row of the child's U, or -1 for none."""
    below: Numbers
    """Tiles below the diagonal."""
    rows: Int[np.ndarray, "below size"]
    """Places of their rows in the order of elimination; past its end for padding."""
    entries: Numbers
    """Places of the entries of the matrix in the tiles."""
    units: Numbers
    """Places of padding on the diagonal, where the matrix is the unit matrix."""
    length: int
    """Number of places in the order of elimination, padded to whole tiles."""
    places: Numbers
    """Place of every unknown in that order; past its end if the unknown is not eliminated."""


def plan(nodes: Sequence[Node], rows: Numbers, columns: Numbers, unknowns: int, size: int) -> Plan:
    """Returns the tables.

    Args:
        nodes: nodes of unknowns, children before their parents.
        rows, columns: rows and columns of the entries of the matrix, a lower triangle.
        unknowns: n.
        size: rows and columns of a tile.
    """
    own, beyond = (np.array([-(-len(node[i]) // size) for node in nodes], int) for i in range(2))
    # Where an unknown is eliminated: its front, and its place in it.
    front_of, place_in = np.full(unknowns, -1), np.zeros(unknowns, int)
    for number, node in enumerate(nodes):
        front_of[node.own], place_in[node.own] = number, np.arange(len(node.own))
    start, length = size * (np.cumsum(own) - own), int(size * own.sum())
    places = np.append(np.where(front_of < 0, length, start[front_of] + place_in), length)
    counts = own * (own + 1) // 2 + own * beyond
    first = np.cumsum(counts) - counts
    stored, end = _storage(nodes, beyond * (beyond + 1) // 2, int(counts.sum()))

    earlier = np.where(places[rows] < places[columns], rows, columns)
    later = rows + columns - earlier
    order = np.argsort(front_of[earlier], kind="stable")
    bounds = np.searchsorted(front_of[earlier][order], np.arange(len(nodes) + 1))
    entries, units = np.empty(len(rows), int), []
    steps, targets, parts, children, below, rows_below = ([] for _ in range(6))
    local, child_rows = np.full(unknowns + 1, -1), 0
    for number, node in enumerate(nodes):
        s, m = int(own[number]), int(own[number] + beyond[number])
        front = np.full(m * size, unknowns)
        front[: len(node.own)] = node.own
        front[s * size :][: len(node.boundary)] = node.boundary
        local[front] = np.arange(m * size)
        tiles = np.arange(m)
        # The first tile of every row of L.
        row = first[number] + np.where(tiles < s, tiles * (tiles + 1) // 2, s * (s + 1) // 2 + (tiles - s) * s)
        mine = order[bounds[number] : bounds[number + 1]]
        entries[mine] = _inside(row, local[later[mine]], local[earlier[mine]], size)
        padding = np.flatnonzero(front[: s * size] == unknowns)
        units.append(_inside(row, padding, padding, size))
        adding = []
        for child in node.children:
            theirs = np.full(m * size, -1)
            theirs[local[nodes[child].boundary]] = np.arange(len(nodes[child].boundary))
            # The tile of U with the first row that is added to each tile, and whether there is one.
            known = theirs.reshape(m, -1)
            window, touched = np.where(known < 0, unknowns, known).min(axis=1) // size, known.max(axis=1) >= 0
            tables = (window, touched, child_rows + size * tiles)
            adding.append((int(stored[child]), int(beyond[child]), *(table.tolist() for table in tables)))
            children.append(theirs)
            child_rows += m * size
        row, left, begin = row.tolist(), int(stored[number]), int(start[number])
        for k in range(s + 1):
            began, began_below, eliminated = len(targets), len(below), k < s
            for i in range(k, m):
                for j in (k,) if eliminated else range(s, i + 1):
                    tile = row[i] + k if eliminated else left + (i - s) * (i - s + 1) // 2 + j - s
                    adds = [
                        _part(at, end, window[i], window[j], size, base[i], base[j])
                        for at, end, window, touched, base in adding
                        if touched[i] and touched[j]
                    ]
                    targets.append((tile, eliminated, row[i], row[j], k, len(parts), len(parts) + len(adds)))
                    parts += adds
                if eliminated and i > k:
                    below.append(row[i] + k)
                    rows_below.append(places[front[i * size : (i + 1) * size]])
            diagonal, place = (row[k] + k, begin + k * size) if eliminated else (0, 0)
            steps.append((began, len(targets), eliminated, diagonal, began_below, len(below), place))
        local[front] = -1
    return Plan(
        size,
        # Two tiles are always read, even where only one exists.
        end + 1,
        Steps(*_columns(steps, 7)),
        Targets(*_columns(targets, 7)),
        Parts(*_columns(parts, 6)),
        np.concatenate([*children, np.full(size, -1)]).astype(np.int32),
        np.array([*below, 0], np.int32),
        np.array([*rows_below, np.full(size, length)], np.int32),
        entries.astype(np.int32),
        np.concatenate([*units, np.empty(0, int)]).astype(np.int32),
        length,
        places[:-1].astype(np.int32),
    )


def _columns(rows: list[tuple[int, ...]], count: int) -> Int[np.ndarray, "count number"]:
    # At least one row, because an empty table cannot be indexed.
    return np.array(rows or [(0,) * count], np.int32).T


def _part(at: int, tiles: int, i: int, j: int, size: int, rows: int, columns: int) -> tuple[int, ...]:
    """Returns a row of `Parts` for the tiles i, i + 1 and j, j + 1 of a U that is stored at `at`."""
    upper, lower = (at + row * (row + 1) // 2 + j for row in (i, min(i + 1, tiles - 1)))
    return upper, lower, i * size, j * size, rows, columns


def _inside(row: Int[np.ndarray, " tiles"], i: Numbers, j: Numbers, size: int) -> Numbers:
    """Returns the places of entries i, j of a front, from the first tiles of its rows."""
    return (row[i // size] + j // size) * size**2 + i % size * size + j % size


def _storage(nodes: Sequence[Node], sizes: Numbers, end: int) -> tuple[Numbers, int]:
    """Returns places from `end` on for the U of the nodes, reusing those already read, and their end."""
    place, holes = np.zeros(len(nodes), int), []
    for number, node in enumerate(nodes):
        size = int(sizes[number])
        fitting = [hole for hole in holes if hole[1] - hole[0] >= size]
        if fitting:
            start, stop = min(fitting, key=lambda hole: hole[1] - hole[0])
            holes.remove((start, stop))
            holes.append((start + size, stop))
        else:
            start, end = end, end + size
        place[number] = start
        for child in node.children:
            holes = _with_hole(holes, int(place[child]), int(place[child] + sizes[child]))
    return place, end


def _with_hole(holes: list[tuple[int, int]], start: int, stop: int) -> list[tuple[int, int]]:
    """Adds a hole, merged with those next to it."""
    kept = []
    for hole in holes:
        if hole[1] == start:
            start = hole[0]
        elif hole[0] == stop:
            stop = hole[1]
        else:
            kept.append(hole)
    return [hole for hole in [*kept, (start, stop)] if hole[1] > hole[0]]
