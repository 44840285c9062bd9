"""Products of matrices as C loops.

Every loop keeps a block of sums in registers, side by side along the contiguous axis of the second matrix. Products
with the same constant share one loop, so that a value and its tangents pass through a network layer together, and the
constant is stored in the order of that loop. A product with one column splits its sums into parts.
"""

from collections.abc import Callable

import numpy as np

from dln_jax.export.c.body import Body
from dln_jax.export.c.nodes import Node, is_constant, values
from dln_jax.export.c.operations import expression
from dln_jax.export.c.text import C_TYPES

_LANES = {"f64": 4, "f32": 8}
_TILE = 64
"""Number of columns summed at once; gcc allocates registers better for wide blocks."""
_ROWS = 16
"""Largest number of rows with separate sums; more rows are a loop over rows."""


def summed(body: Body, count: int, parts: int, add: Callable[[str, str], str]) -> None:
    """Declares a real `sum_` of `count` terms, computed in partial sums that vectorise.

    `add(k, total)` returns the C of the total and term k; `parts` is a power of 2.
    """
    whole = count // parts * parts if parts > 1 else 0
    if whole:
        body.declared("part_", "real", parts, "{0}")
        with body.block(f"for (int k_ = 0; k_ < {whole}; k_ += {parts})"):
            body.line(f"for (int c_ = 0; c_ < {parts}; ++c_) part_[c_] = {add('(k_ + c_)', 'part_[c_]')};")
        while parts := parts // 2:
            body.line(f"for (int c_ = 0; c_ < {parts}; ++c_) part_[c_] += part_[c_ + {parts}];")
    body.line(f"real sum_ = {'part_[0]' if whole else 0};")
    if whole < count:
        body.line(f"for (int k_ = {whole}; k_ < {count}; ++k_) sum_ = {add('k_', 'sum_')};")


def dot_general(body: Body, members: list[Node]) -> None:
    """Writes the products of several matrices with the same second matrix."""
    for node in members:
        body.kept(node)
    (batch, _, count), columns = members[0].args[0].shape, members[0].args[1].shape[2]
    real = members[0].dtype == "real"
    if real and columns == 1:
        for node in members:
            _dots(body, node)
        return
    small = [node for node in members if real and batch == 1 and node.shape[1] <= _ROWS]
    rows = [(node, row) for node in small for row in range(node.shape[1])]
    while rows:
        blocks = -(-len(rows) // 4)
        size = -(-len(rows) // blocks)
        _block(body, rows[:size], count, columns)
        rows = rows[size:]
    for node in members:
        if node not in small:
            _many(body, node)


def _parts(rows: int, columns: int, count: int) -> int:
    """Returns the number of partial sums per column: with few columns, several hide the latency of an addition."""
    parts = {1: 4 if columns <= 32 else 1, 2: 2 if columns <= 16 else 1}.get(rows, 1)
    while count % parts:
        parts //= 2
    return parts


def _block(body: Body, rows: list[tuple[Node, int]], count: int, columns: int) -> None:
    """Writes rows of products with one matrix."""
    lanes, factor = _LANES[body.source.precision], rows[0][0].args[1]
    body.spend(multiply_add=len(rows) * count * columns)
    start = 0
    while start < columns:
        width = min(_TILE, columns - start)
        tiles = (columns - start) // width
        # Constants are padded to whole vectors.
        wide = -(-width // lanes) * lanes if is_constant(factor) else width
        parts = _parts(len(rows), wide, count)
        column = start + np.arange(tiles)[:, None, None] * width + np.arange(wide)
        at = np.arange(count)[None, :, None] * columns + column
        names = ["n_", "(k_ + p_)" if parts > 1 else "k_", "c_"]
        if is_constant(factor):
            inside = np.broadcast_to(column < columns, at.shape)
            matrix = body.literal(np.where(inside, values(factor).ravel()[np.where(inside, at, 0)], 0), "real", names)
        else:
            matrix = body.read(factor, at, names)
        with body.loops({"n_": tiles}):
            for number in range(len(rows)):
                body.declared(f"s{number}_", "real", parts * wide, "{0}")
            parted = {"p_": parts} if parts > 1 else {}
            with body.block(f"for (int k_ = 0; k_ < {count}; k_ += {parts})"), body.loops(parted):
                for number, (node, row) in enumerate(rows):
                    text = body.read(node.args[0], row * count + np.arange(count), names[1:2])
                    body.line(f"const real x{number}_ = {text};")
                with body.loops({"c_": wide}):
                    body.line(f"const real w_ = {matrix};")
                    for number in range(len(rows)):
                        target = f"s{number}_[{f'{wide} * p_ + c_' if parts > 1 else 'c_'}]"
                        body.line(f"{target} = MULTIPLY_ADD(x{number}_, w_, {target});")
            with body.loops({"c_": width}):
                for number, (node, row) in enumerate(rows):
                    target = body.index(row * columns + column[:, 0, :width], ["n_", "c_"])
                    total = " + ".join(
                        f"s{number}_[{f'{wide * part} + c_' if part else 'c_'}]" for part in range(parts)
                    )
                    body.line(f"{body.name(node)}[{target}] = {total};")
        start += tiles * width


def _many(body: Body, node: Node) -> None:
    """Writes a product of many rows, of a batch of matrices, or of integers or booleans."""
    a, b = node.args
    (batch, m, count), columns = a.shape, b.shape[2]
    body.spend(multiply_add=batch * m * count * columns * (node.dtype == "real"))
    kind = C_TYPES[node.dtype]
    for start in range(0, columns, _TILE):
        width = min(_TILE, columns - start)
        i, j, k, c = np.meshgrid(*map(np.arange, (batch, m, count, width)), indexing="ij")
        with body.loops({"b_": batch, "r_": m}):
            body.declared("s_", node.dtype, width, "{0}")
            with body.loops({"k_": count}):
                first = body.read(a, ((i * m + j) * count + k)[..., 0], ["b_", "r_", "k_"])
                body.line(f"const {kind} x_ = {first};")
                with body.loops({"c_": width}):
                    text = body.read(b, ((i * count + k) * columns + start + c)[:, 0], ["b_", "k_", "c_"])
                    body.line(f"s_[c_] = {expression('multiply_add', node.dtype, 'x_', text, 's_[c_]')};")
            target = body.index(((i * m + j) * columns + start + c)[:, :, 0], ["b_", "r_", "c_"])
            body.line(f"for (int c_ = 0; c_ < {width}; ++c_) {body.name(node)}[{target}] = s_[c_];")


def _dots(body: Body, node: Node) -> None:
    """Writes a product with one column."""
    a, b = node.args
    batch, m, count = a.shape
    body.spend(multiply_add=batch * m * count)
    parts = 2 * _LANES[body.source.precision]
    i, j, k = np.meshgrid(np.arange(batch), np.arange(m), np.arange(count), indexing="ij")

    def add(index: str, total: str) -> str:
        first = body.read(a, (i * m + j) * count + k, ["b_", "r_", index])
        return f"MULTIPLY_ADD({first}, {body.read(b, (i * count + k)[:, 0], ['b_', index])}, {total})"

    with body.loops({"b_": batch, "r_": m}):
        summed(body, count, parts, add)
        body.line(f"{body.name(node)}[{body.index((i * m + j)[..., 0], ['b_', 'r_'])}] = sum_;")
