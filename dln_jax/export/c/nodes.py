"""Nodes of a program of small arrays, and what is known about them beforehand."""

from dataclasses import dataclass
from math import prod
from typing import Any, NamedTuple

import numpy as np

Region = tuple[int, ...]
"""The loops and branches that a node is in, outermost first."""


@dataclass(frozen=True, eq=False)
class Node:
    """An array that a program computes; equal ones are the same object."""

    op: str
    shape: tuple[int, ...]
    dtype: str
    """A kind of `kinds.C_TYPES`."""
    args: tuple["Node", ...]
    attribute: Any
    value: np.ndarray | None
    """Numbers of a `const`, positions of an `arrange` [shape]."""
    region: Region
    number: int

    def __hash__(self) -> int:
        """Its number: an address would order sets of nodes, and so the text, differently in each process."""
        return self.number

    @property
    def size(self) -> int:
        """Number of elements."""
        return prod(self.shape)


class Loop(NamedTuple):
    """Inside of a `while`, `repeat` or `branch`."""

    carries: list[Node]
    """What a turn starts with; nothing for a branch."""
    conditions: list[Node]
    """Whether there is another turn, of a `while`."""
    results: list[Node]
    """New carries, then what each turn of a `repeat` leaves; results of each branch in turn."""
    length: int | None = None
    """Turns of a `repeat`."""
    reverse: bool = False


def is_constant(node: Node) -> bool:
    """Whether it is known beforehand."""
    return node.op == "const" or (node.op == "arrange" and all(arg.op == "const" for arg in node.args))


def values(node: Node) -> np.ndarray:
    """Numbers of a node that is known beforehand."""
    if node.op == "const":
        return np.asarray(node.value)
    return np.asarray(np.concatenate([values(arg).ravel() for arg in node.args])[np.asarray(node.value)])


def is_all(node: Node, number: Any) -> bool:
    """Whether all elements are known to be a number."""
    return is_constant(node) and bool((values(node) == number).all())


def is_uniform(node: Node) -> bool:
    """Whether all elements are known to be one and the same."""
    if node.op == "const":
        array = np.asarray(node.value)
        return array.size > 0 and bool((array == array.flat[0]).all())
    return node.op == "arrange" and node.value is not None and bool((node.value == node.value.flat[0]).all())


def without_unused(sources: list[Node], positions: np.ndarray) -> tuple[list[Node], np.ndarray]:
    """Each source once, and only those of which something is taken."""
    starts = np.cumsum([0, *(source.size for source in sources)])
    owner = np.searchsorted(starts, positions, side="right") - 1
    kept, start, moved = {}, 0, np.zeros(len(sources), np.int64)
    for index in np.unique(owner):
        source = sources[index]
        if source not in kept:
            kept[source] = start
            start += source.size
        moved[index] = kept[source] - starts[index]
    return list(kept), np.asarray(positions + moved[owner])
