"""Products of matrices as C loops.

Every loop keeps a block of sums in registers, side by side along the contiguous axis of the second matrix. Products
with the same constant share one loop, so that a value and its tangents pass through a network's layer together, and
the constant is stored in the order of that loop. A product with one column splits its sums into parts.
"""

import functools
from collections.abc import Callable

import numpy as np

from dln_jax.export.c.body import Body
from dln_jax.export.c.kinds import C_TYPES
from dln_jax.export.c.nodes import Node, is_constant, values
from dln_jax.export.c.operations import expression

_LANES = {"f64": 4, "f32": 8}
_TILE = 64
"""Columns whose sums are kept at once; gcc allocates registers better for wide blocks."""
_ROWS = 16
"""Largest number of rows that get sums of their own; a product with more is a loop over rows."""


def chain(pairs: list[tuple[str, str]], dtype: str) -> str:
    """Returns the C of a sum of products, as nested multiply-adds."""
    (first, second), *rest = pairs
    if dtype != "real":
        product, total = _of_integers(dtype)
        return functools.reduce(total, [product(*pair) for pair in pairs])
    text = f"{first} * {second}"
    for first, second in rest:
        text = f"MULTIPLY_ADD({first}, {second}, {text})"
    return text


def _of_integers(dtype: str) -> list[Callable[[str, str], str]]:
    """Returns functions that give the C of a product and of a sum (for booleans: and, or)."""
    return [functools.partial(expression, op, dtype) for op in (("and", "or") if dtype == "bool" else ("mul", "add"))]


def dot_general(body: Body, members: list[Node]) -> None:
    """Writes the products of several matrices with the same second matrix."""
    for node in members:
        body.kept(node)
    if members[0].dtype != "real":
        for node in members:
            _whole(body, node)
        return
    (batch, _, count), columns = members[0].args[0].shape, members[0].args[1].shape[2]
    if columns == 1:
        for node in members:
            _dots(body, node)
        return
    small = [node for node in members if batch == 1 and node.shape[1] <= _ROWS]
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
    """Returns how many partial sums a column has: with few columns, several hide the latency of an addition."""
    parts = {1: 4 if columns <= 32 else 1, 2: 2 if columns <= 16 else 1}.get(rows, 1)
    while count % parts:
        parts //= 2
    return parts


def _block(body: Body, rows: list[tuple[Node, int]], count: int, columns: int) -> None:
    """Writes rows of products with one matrix."""
    lanes, factor = _LANES[body.source.precision], rows[0][0].args[1]
    body.spend(2 * len(rows) * count * columns)
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
        body.opened(f"for (int n_ = 0; n_ < {tiles}; ++n_)")
        for number in range(len(rows)):
            body.line(f"real s{number}_[{parts * wide}] = {{0}};")
        body.opened(f"for (int k_ = 0; k_ < {count}; k_ += {parts})")
        if parts > 1:
            body.opened(f"for (int p_ = 0; p_ < {parts}; ++p_)")
        for number, (node, row) in enumerate(rows):
            body.line(f"const real x{number}_ = {body.read(node.args[0], row * count + np.arange(count), names[1:2])};")
        body.opened(f"for (int c_ = 0; c_ < {wide}; ++c_)")
        body.line(f"const real w_ = {matrix};")
        for number in range(len(rows)):
            target = f"s{number}_[{f'{wide} * p_ + c_' if parts > 1 else 'c_'}]"
            body.line(f"{target} = MULTIPLY_ADD(x{number}_, w_, {target});")
        for _ in range(3 if parts > 1 else 2):
            body.closed()
        body.opened(f"for (int c_ = 0; c_ < {width}; ++c_)")
        for number, (node, row) in enumerate(rows):
            target = body.index(row * columns + column[:, 0, :width], ["n_", "c_"])
            total = " + ".join(f"s{number}_[{f'{wide * part} + c_' if part else 'c_'}]" for part in range(parts))
            body.line(f"{body.name(node)}[{target}] = {total};")
        body.closed()
        body.closed()
        start += tiles * width


def _many(body: Body, node: Node) -> None:
    """Writes a product of many rows, or of a batch of matrices."""
    a, b = node.args
    (batch, m, count), columns = a.shape, b.shape[2]
    body.spend(2 * batch * m * count * columns)
    for start in range(0, columns, _TILE):
        width = min(_TILE, columns - start)
        index = [np.arange(extent) for extent in (batch, m, count, width)]
        i, j, k, c = np.meshgrid(*index, indexing="ij")
        names = ["b_", "r_", "k_", "c_"]
        body.opened(f"for (int b_ = 0; b_ < {batch}; ++b_)")
        body.opened(f"for (int r_ = 0; r_ < {m}; ++r_)")
        body.line(f"real s_[{width}] = {{0}};")
        body.opened(f"for (int k_ = 0; k_ < {count}; ++k_)")
        body.line(f"const real x_ = {body.read(a, ((i * m + j) * count + k)[..., 0], names[:3])};")
        body.opened(f"for (int c_ = 0; c_ < {width}; ++c_)")
        text = body.read(b, ((i * count + k) * columns + start + c)[:, 0], ["b_", "k_", "c_"])
        body.line(f"s_[c_] = MULTIPLY_ADD(x_, {text}, s_[c_]);")
        body.closed()
        body.closed()
        target = body.index(((i * m + j) * columns + start + c)[:, :, 0], ["b_", "r_", "c_"])
        body.line(f"for (int c_ = 0; c_ < {width}; ++c_) {body.name(node)}[{target}] = s_[c_];")
        body.closed()
        body.closed()


def _whole(body: Body, node: Node) -> None:
    """Writes a product of integers or booleans."""
    a, b = node.args
    (batch, m, count), columns = a.shape, b.shape[2]
    i, j, k, c = np.meshgrid(*map(np.arange, (batch, m, count, columns)), indexing="ij")
    kind, (product, total) = C_TYPES[node.dtype], _of_integers(node.dtype)
    for name, extent in (("b_", batch), ("r_", m), ("c_", columns)):
        body.opened(f"for (int {name} = 0; {name} < {extent}; ++{name})")
    body.line(f"{kind} sum_ = 0;")
    first = body.read(a, ((i * m + j) * count + k)[..., 0], ["b_", "r_", "k_"])
    second = body.read(b, ((i * count + k) * columns + c)[:, 0], ["b_", "k_", "c_"])
    term = total("sum_", product(first, second))
    body.line(f"for (int k_ = 0; k_ < {count}; ++k_) sum_ = {term};")
    target = body.index(((i * m + j) * columns + c)[:, :, 0], ["b_", "r_", "c_"])
    body.line(f"{body.name(node)}[{target}] = sum_;")
    for _ in range(3):
        body.closed()


def _dots(body: Body, node: Node) -> None:
    """Writes a product with one column."""
    a, b = node.args
    batch, m, count = a.shape
    body.spend(2 * batch * m * count)
    parts = 2 * _LANES[body.source.precision]
    parts = parts if count >= parts else 1
    whole = count // parts * parts
    i, j, k = np.meshgrid(np.arange(batch), np.arange(m), np.arange(count), indexing="ij")

    def both(index: str) -> str:
        first = body.read(a, (i * m + j) * count + k, ["b_", "r_", index])
        return f"MULTIPLY_ADD({first}, {body.read(b, (i * count + k)[:, 0], ['b_', index])}"

    body.opened(f"for (int b_ = 0; b_ < {batch}; ++b_)")
    body.opened(f"for (int r_ = 0; r_ < {m}; ++r_)")
    body.line("real sum_ = 0;")
    if parts > 1:
        body.line(f"real part_[{parts}] = {{0}};")
        body.opened(f"for (int k_ = 0; k_ < {whole}; k_ += {parts})")
        body.line(f"for (int c_ = 0; c_ < {parts}; ++c_) part_[c_] = {both('(k_ + c_)')}, part_[c_]);")
        body.closed()
        half = parts // 2
        while half:
            body.line(f"for (int c_ = 0; c_ < {half}; ++c_) part_[c_] += part_[c_ + {half}];")
            half //= 2
        body.line("sum_ = part_[0];")
    if whole < count or parts == 1:
        body.line(f"for (int k_ = {whole if parts > 1 else 0}; k_ < {count}; ++k_) sum_ = {both('k_')}, sum_);")
    body.line(f"{body.name(node)}[{body.index((i * m + j)[..., 0], ['b_', 'r_'])}] = sum_;")
    body.closed()
    body.closed()
