"""Nodes of a program of small arrays, the values of constant nodes, and the choice of unrolled nodes."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Any, NamedTuple

import numpy as np

from dln_jax.export.c.operations import TRANSCENDENTAL

UNROLL_LIMIT = 64
"""Largest number of unrolled elements of a result, or of products in a sum; structural zeros do not count."""
VECTOR = 8
VECTOR_OF_FUNCTIONS = 4
"""Results with fewer elements are always unrolled; the second limit is for functions of <math.h>."""
_MOST_ZEROS = 16 * UNROLL_LIMIT
"""Largest number of elements, including structural zeros, of an unrolled result."""
_MOST_SCALARS = 36
"""Largest number of elements of an unrolled operation on scalars; larger operations are faster as loops."""
_TRIVIAL = {
    "mul": np.logical_or, "add": np.logical_or, "sub": np.logical_or, "div": lambda a, b: a, "neg": lambda a: a,
    "select": lambda condition, a, b: a & b,
}  # fmt: skip
"""Masks of zero arguments -> mask of elements at no cost, for an operation on finite numbers."""
Region = tuple[int, ...]
"""Numbers of the loops and branches around a node, outermost first."""


@dataclass(frozen=True, eq=False)
class Node:
    """An array computed by a program; equal nodes are one object."""

    op: str
    shape: tuple[int, ...]
    dtype: str
    """Key of `kinds.C_TYPES`."""
    args: tuple["Node", ...]
    attribute: Any
    value: np.ndarray | None
    """Numbers of a `const`, or positions [shape] of a `gather`."""
    region: Region
    number: int

    def __hash__(self) -> int:
        """Returns the number. Addresses would change the order of sets, and so the text, between processes."""
        return self.number

    @property
    def size(self) -> int:
        """Number of elements."""
        return prod(self.shape)


class Loop(NamedTuple):
    """Body of a `while` or `repeat`, or one case of a `branch`."""

    carries: list[Node]
    """State at the start of an iteration; empty for a branch."""
    conditions: list[Node]
    """Condition of a `while` for another iteration."""
    results: list[Node]
    """New carries, then the stacked outputs of a `repeat`; the results of a branch."""
    length: int | None = None
    """Iterations of a `repeat`."""
    reverse: bool = False


def is_constant(node: Node) -> bool:
    """Returns whether the value is known at compile time."""
    return node.op == "const" or (node.op == "gather" and all(arg.op == "const" for arg in node.args))


def values(node: Node) -> np.ndarray:
    """Returns the value of a constant node."""
    return known(node)[1].reshape(node.shape)


def is_all(node: Node, number: Any) -> bool:
    """Returns whether all elements are known to be this number."""
    return is_constant(node) and bool((values(node) == number).all())


def is_uniform(node: Node) -> bool:
    """Returns whether all elements are known to be equal."""
    array = node.value
    return array is not None and array.size > 0 and bool((array == array.flat[0]).all())


def known(node: Node) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mask [size] of constant elements, and their values (zero for the others)."""
    if node.op == "const":
        return np.ones(node.size, bool), np.asarray(node.value).ravel()
    if node.op == "gather":
        masks, numbers = zip(*map(known, node.args), strict=True)
        positions = np.asarray(node.value).ravel()
        return np.concatenate(masks)[positions], np.concatenate(numbers)[positions]
    return np.zeros(node.size, bool), np.zeros(node.size)


def zeros(node: Node) -> np.ndarray:
    """Returns the mask [size] of known zeros."""
    mask, numbers = known(node)
    return mask & (numbers == 0)


def is_direct(node: Node) -> bool:
    """Returns whether the positions of a gather are linear in the indices of a loop."""
    return len(node.args) == 1 and node.value is not None and None not in steps(node.value)


def steps(positions: np.ndarray) -> list[int | None]:
    """Returns the step of the positions along each axis, or None for varying steps."""
    every = [np.diff(positions, axis=axis) for axis in range(positions.ndim)]
    return [0 if not step.size else None if np.ptp(step) else int(step.flat[0]) for step in every]


def owners(sources: Sequence[Node], positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the source index of every position in the concatenated sources, and the first position of each source."""
    starts = np.cumsum([0, *(source.size for source in sources)])
    return np.searchsorted(starts, positions, side="right") - 1, starts


def sources_of(node: Node) -> tuple[Sequence[Node], np.ndarray]:
    """Returns the concatenated source nodes of a node, and the positions [size] of its elements in them."""
    return (node.args, np.ravel(node.value)) if node.op == "gather" else ((node,), np.arange(node.size))


def read_source(node: Node, positions: np.ndarray) -> tuple[Node, np.ndarray]:
    """Returns the single source of a `gather` at these positions, and the positions in it."""
    positions = np.asarray(np.asarray(node.value).ravel()[positions])
    owner, starts = owners(node.args, positions)
    first = int(owner.flat[0])
    assert (owner == first).all(), "a loop reads from several arrays"
    return node.args[first], np.asarray(positions - starts[first])


def without_unused(sources: list[Node], positions: np.ndarray) -> tuple[list[Node], np.ndarray]:
    """Returns the distinct sources in use, and the positions in them."""
    owner, starts = owners(sources, positions)
    kept, start, moved = {}, 0, np.zeros(len(sources), np.int64)
    for index in np.unique(owner):
        source = sources[index]
        if source not in kept:
            kept[source] = start
            start += source.size
        moved[index] = kept[source] - starts[index]
    return list(kept), np.asarray(positions + moved[owner])


def unrolls(op: str, args: tuple[Node, ...], shape: tuple[int, ...], *, finite: bool) -> bool:
    """Returns whether an elementwise operation is written element by element.

    Unrolling small operations makes moving their elements free, and compilers keep them in registers.
    """
    size, functions = prod(shape), op in TRANSCENDENTAL and args[0].dtype == "real"
    if size < (VECTOR_OF_FUNCTIONS if functions else VECTOR):
        return shape != () and size > 0
    if functions or size > _MOST_ZEROS:
        return False
    scattered = (arg for arg in args if arg.op == "gather" and not is_direct(arg))
    if size <= UNROLL_LIMIT and any(size <= _MOST_SCALARS or _is_mixed(arg) for arg in scattered):
        return True
    if not finite or op not in _TRIVIAL:
        return False
    trivial = _TRIVIAL[op](*(np.broadcast_to(zeros(arg), size) for arg in args))
    return bool(trivial.any()) and size - trivial.sum() <= UNROLL_LIMIT


def _is_mixed(gather: Node) -> bool:
    """Returns whether a gather reads arrays that a loop would have to copy."""
    return any(arg.size > 1 or arg.op == "const" for arg in gather.args)


def unrolls_product(a: Node, b: Node, *, finite: bool) -> bool:
    """Returns whether a product of matrices [b, m, k] and [b, k, n] is written element by element.

    Constants with several columns are not unrolled, because other products with the same constant share the loop.
    """
    (batch, m, k), n = a.shape, b.shape[2]
    if batch * m * k * n <= UNROLL_LIMIT and not (is_constant(b) and n >= VECTOR_OF_FUNCTIONS):
        return True
    if not finite or batch * m * n > _MOST_ZEROS:
        return False
    left, right = (~zeros(node).reshape(node.shape) for node in (a, b))
    return not (left.all() and right.all()) and int(np.matmul(left.astype(int), right).sum()) <= UNROLL_LIMIT
