"""Copies of what moves elements: boxes of them that a loop can follow, each from one source."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from dln_jax.export.c.body import Body
from dln_jax.export.c.nodes import Node
from dln_jax.export.c.plan import WRITTEN_OUT, strides

_BOXES = 6
"""Up to which each is a loop; positions are read from tables where there were more."""


def merged(shape: Sequence[int], steps: list[tuple[int, ...] | None]) -> list[int]:
    """The shape with neighbouring axes as one where all readings allow it; never without an axis."""
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
    """Copies all elements of a node to an array; to its own, from where they come."""
    index = np.arange(node.size).reshape(node.shape)
    stored = node in body.plan.arrays and not own
    if node.size <= WRITTEN_OUT and not stored:
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
    """Reading, through an arrange that is itself kept where it is its own copy."""
    if not (own and node.op == "arrange"):
        return body.read(node, positions, names)
    starts = np.cumsum([0, *(arg.size for arg in node.args)])
    inside = np.asarray(np.asarray(node.value).ravel()[positions])
    first = int(np.searchsorted(starts, inside.flat[0], side="right")) - 1
    return body.read(node.args[first], np.asarray(inside - starts[first]), names)


def _boxes(node: Node, index: np.ndarray) -> list[np.ndarray]:
    """Boxes of elements that a loop can follow, each from one source."""
    if node.op != "arrange" or node.value is None:
        return [index]
    starts = np.cumsum([0, *(arg.size for arg in node.args)])
    owner = (np.searchsorted(starts, node.value, side="right") - 1).ravel()
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
    """Elements of each source, [leading axes along which the source is the same, its elements of the others]."""
    starts = np.cumsum([0, *(arg.size for arg in node.args)])
    owner = np.searchsorted(starts, np.asarray(node.value), side="right") - 1
    leading = []
    while len(leading) < index.ndim - 1 and (owner == owner[:1]).all():
        leading.append(index.shape[len(leading)])
        owner = owner[0]
    rows = index.reshape(*leading, -1)
    return [rows[..., owner.ravel() == source] for source in np.unique(owner)]


def _runs(at: np.ndarray, owner: np.ndarray) -> list[int]:
    """Where runs of rows from the same sources with equal steps begin, and the end."""
    steps, cuts = np.diff(at, axis=0), [0]
    for row in range(1, len(at)):
        first = cuts[-1]
        uneven = row > first + 1 and not np.array_equal(steps[row - 1], steps[first])
        if uneven or not np.array_equal(owner[row], owner[first]):
            cuts.append(row)
    return [*cuts, len(at)]
