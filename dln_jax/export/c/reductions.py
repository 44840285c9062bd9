"""Rules that turn JAX's products and reductions into nodes of a program."""

from collections.abc import Callable
from functools import partial
from math import prod
from typing import Any

import numpy as np

from dln_jax.export.c.kinds import NUMPY_TYPES
from dln_jax.export.c.nodes import Node
from dln_jax.export.c.primitives import Rule, convert
from dln_jax.export.c.program import Program


def _dot_general(program: Program, parameters, a: Node, b: Node, *, dtype: str) -> Node:
    a, b = convert(program, a, dtype), convert(program, b, dtype)
    (a_sum, b_sum), (a_batch, b_batch) = parameters["dimension_numbers"]
    a_free = [axis for axis in range(len(a.shape)) if axis not in (*a_sum, *a_batch)]
    b_free = [axis for axis in range(len(b.shape)) if axis not in (*b_sum, *b_batch)]

    def ordered(node: Node, *groups) -> Node:
        index = np.arange(node.size).reshape(node.shape).transpose([axis for group in groups for axis in group])
        return program.gather([node], index.reshape([prod(node.shape[axis] for axis in group) for group in groups]))

    product = program.dot_general(ordered(a, a_batch, a_free, a_sum), ordered(b, b_batch, b_sum, b_free))
    shape = [a.shape[axis] for axis in (*a_batch, *a_free)] + [b.shape[axis] for axis in b_free]
    return program.reshape(product, shape)


def rows_of(program: Program, node: Node, axes: tuple[int, ...]) -> Node:
    """Returns the node as a matrix [o, r], its columns the elements along `axes`."""
    kept = [axis for axis in range(len(node.shape)) if axis not in axes]
    index = np.arange(node.size).reshape(node.shape).transpose([*kept, *axes])
    return program.gather([node], index.reshape(prod(node.shape[axis] for axis in kept), -1))


def _limit(dtype: str, *, upper: bool) -> Any:
    """Returns the lower or upper limit of the numbers of a kind."""
    if dtype in ("real", "bool"):
        return upper if dtype == "bool" else np.inf if upper else -np.inf
    limits = np.iinfo(NUMPY_TYPES[dtype])
    return limits.max if upper else limits.min


def _reduction(op: str, start: Callable[[str], Any]) -> Rule:
    """Returns the rule of a reduction; `start` gives the value for an empty array of a kind."""

    def rule(program: Program, parameters, node: Node) -> Node:
        axes = tuple(map(int, parameters["axes"]))
        shape = [size for axis, size in enumerate(node.shape) if axis not in axes]
        if node.size == 0:
            return program.broadcast(program.constant(start(node.dtype), node.dtype), shape)
        rows = rows_of(program, node, axes)
        if rows.shape[1] == 1:
            return program.reshape(rows, shape)
        if rows.shape[1] == 2:
            first, second = (program.gather([rows], np.arange(rows.size).reshape(rows.shape)[:, k]) for k in range(2))
            return program.reshape(program.elementwise(op, first, second), shape)
        return program.reshape(program.make(f"reduce_{op}", rows.shape[:1], node.dtype, [rows]), shape)

    return rule


def _extreme(op: str) -> Rule:
    """Returns the rule of max or min; for booleans that is or, and."""
    on_truths = _reduction("or" if op == "max" else "and", lambda _: op == "min")
    others = _reduction(op, partial(_limit, upper=op == "min"))
    return lambda program, parameters, node: (on_truths if node.dtype == "bool" else others)(program, parameters, node)


def _arg(name: str) -> Rule:
    def rule(program: Program, parameters, node: Node, *, dtype: str) -> Node:
        (axis,) = map(int, parameters["axes"])
        shape = node.shape[:axis] + node.shape[axis + 1 :]
        rows = rows_of(program, node, (axis,))
        return program.reshape(program.make(name, rows.shape[:1], dtype, [rows]), shape)

    return rule


def _cumulative(op: str) -> Rule:
    """Returns the rule of a cumulative operation, unrolled along the axis."""

    def rule(program: Program, parameters, node: Node) -> Node:
        axis = parameters["axis"]
        index = np.moveaxis(np.arange(node.size).reshape(node.shape), axis, 0)
        index = index[::-1] if parameters["reverse"] else index
        pieces: list[Node] = []
        for positions in index:
            piece = program.gather([node], positions)
            pieces.append(program.elementwise(op, pieces[-1], piece) if pieces else piece)
        if parameters["reverse"]:
            pieces.reverse()
        joined = np.arange(node.size).reshape(index.shape)
        return program.gather(pieces, np.moveaxis(joined, 0, axis)) if pieces else node

    return rule


RULES: dict[str, Rule] = {
    "reduce_sum": _reduction("add", lambda _: 0),
    "reduce_prod": _reduction("mul", lambda _: 1),
    "reduce_max": _extreme("max"),
    "reduce_min": _extreme("min"),
    "reduce_and": _reduction("and", lambda kind: ~NUMPY_TYPES[kind](0)),
    "reduce_or": _reduction("or", lambda _: 0),
    "reduce_xor": _reduction("xor", lambda _: 0),
    "cumsum": _cumulative("add"),
    "cumprod": _cumulative("mul"),
    "cummax": _cumulative("max"),
    "cummin": _cumulative("min"),
}
"""Rules by the name of the primitive."""
TYPED_RULES: dict[str, Rule] = {
    "dot_general": _dot_general,
    "argmax": _arg("argmax"),
    "argmin": _arg("argmin"),
}
"""Rules that also take the kind of the result."""
