"""C that copies the elements of gathers, split into boxes that one loop nest can read from one source."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from dln_jax.export.c.body import Body
from dln_jax.export.c.nodes import Node, owners, read_source
from dln_jax.export.c.plan import UNROLL_LIMIT, strides

_BOXES = 6
"""Largest number of boxes that become loops of their own; more are read through tables of positions."""


def merged(shape: Sequence[int], steps: list[tuple[int, ...] | None]) -> list[int]:
    """Returns the shape with neighbouring axes merged where all readings allow it; at least one axis remains."""
    result: list[int] = []
    kept: list[int] = []
    for axis, extent in enumerate(shape):
        if extent == 1 and len(shape) > 1 and (result or axis + 1 < len(shape)):
            continue
        before = kept[-1] if kept else None
        joined = before is not None and all(step is not None and step[before] == step[axis] * extent for step in steps)
        if joined:
            result[-1] *= extent
            kept[-1] = axis
        else:
            result.append(extent)
            kept.append(axis)
    return result or [1]


def copied(body: Body, node: Node, target: str, *, own: bool = False) -> None:
    """Writes a copy of a node to an array; with `own`, the array that is to hold a gather."""
    index = np.arange(node.size).reshape(node.shape)
    stored = node in body.plan.arrays and not own
    if node.size <= UNROLL_LIMIT and not stored:
        for k in range(node.size):
            body.line(f"{target}[{k}] = {_moved(body, node, np.array(k), own)};")
        return
    boxes = [index] if stored else _boxes(node, index)
    for box in boxes if len(boxes) <= _BOXES else _by_source(node, index):
        box = box.reshape(box.shape or (1,))
        body.looped(
            box.shape,
            lambda names, box=box: body.line(
                f"{target}[{body.index(box, names)}] = {_moved(body, node, box, own, names)};"
            ),
        )


def _moved(body: Body, node: Node, positions: np.ndarray, own: bool, names: Sequence[str] = ()) -> str:
    """Returns the C expression of elements; with `own`, of the sources of a gather that an array will hold."""
    return body.read(*(read_source(node, positions) if own and node.op == "gather" else (node, positions)), names)


def _boxes(node: Node, index: np.ndarray) -> list[np.ndarray]:
    """Splits the elements into boxes, such that one loop nest reads a box from one source."""
    if node.op != "gather" or node.value is None:
        return [index]
    owner = owners(node.args, node.value)[0].ravel()
    flat = node.value.ravel()

    def split(box: np.ndarray) -> list[np.ndarray]:
        at, of = flat[box], owner[box]
        if strides(at) is not None and (of == of.flat[0]).all():
            return [box]
        cuts = {axis: _runs(np.moveaxis(at, axis, 0), np.moveaxis(of, axis, 0)) for axis in range(at.ndim)}
        axis = min(
            (choice for choice in cuts if len(cuts[choice]) > 2), key=lambda choice: len(cuts[choice]), default=None
        )
        if axis is None:
            axis = next(choice for choice in range(at.ndim) if at.shape[choice] > 1)
            cuts[axis] = list(range(at.shape[axis] + 1))
        return [
            part
            for low, high in pairwise(cuts[axis])
            for part in split(box[(slice(None),) * axis + (slice(low, high),)])
        ]

    return split(index)


def _by_source(node: Node, index: np.ndarray) -> list[np.ndarray]:
    """Returns the elements of every source, as [axes along which the source does not change, the rest as one axis]."""
    owner, _ = owners(node.args, np.asarray(node.value))
    leading = []
    while len(leading) < index.ndim - 1 and (owner == owner[:1]).all():
        leading.append(index.shape[len(leading)])
        owner = owner[0]
    rows = index.reshape(*leading, -1)
    return [rows[..., owner.ravel() == source] for source in np.unique(owner)]


def _runs(at: np.ndarray, owner: np.ndarray) -> list[int]:
    """Returns the starts, and the end, of the runs of rows with the same sources and equal steps."""
    steps, cuts = np.diff(at, axis=0), [0]
    for row in range(1, len(at)):
        first = cuts[-1]
        uneven = row > first + 1 and not np.array_equal(steps[row - 1], steps[first])
        if uneven or not np.array_equal(owner[row], owner[first]):
            cuts.append(row)
    return [*cuts, len(at)]
