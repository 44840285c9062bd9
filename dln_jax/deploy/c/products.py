"""Products of matrices as C loops.

Each loop keeps a block of sums in registers, side by side along the contiguous axis of the second matrix. Products with
the same constant are one loop, so that value and tangents go through a matrix together; a constant is stored in the
order of that loop. Where there is one column, sums are kept in parts.
"""

import numpy as np

from dln_jax.deploy.c.program import Node, is_constant, values

_LANES = {"f64": 4, "f32": 8}
_TILE = 64
"""Columns whose sums are kept at once: the more, the better gcc keeps them in registers."""
_ROWS = 16
"""Rows of one product up to which each is named; a loop goes over more."""


def chain(pairs: list[tuple[str, str]]) -> str:
    """a b + ... as nested multiply-adds."""
    (first, second), *rest = pairs
    text = f"{first} * {second}"
    for first, second in rest:
        text = f"MULTIPLY_ADD({first}, {second}, {text})"
    return text


def contracted(body, members: list[Node]) -> None:
    """Products of several matrices with one."""
    for node in members:
        body.declared(body.name(node), "real", node.size)
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
    """Sums of a column side by side: few columns take several to hide the latency of an addition."""
    parts = {1: 4 if columns <= 32 else 1, 2: 2 if columns <= 16 else 1}.get(rows, 1)
    while count % parts:
        parts //= 2
    return parts


def _block(body, rows: list[tuple[Node, int]], count: int, columns: int) -> None:
    """Rows of products with one matrix."""
    lanes, factor = _LANES[body.source.precision], rows[0][0].args[1]
    body.spend(2 * len(rows) * count * columns)
    start = 0
    while start < columns:
        width = min(_TILE, columns - start)
        tiles = (columns - start) // width
        # What is constant is padded to whole vectors.
        wide = -(-width // lanes) * lanes if is_constant(factor) else width
        parts = _parts(len(rows), wide, count)
        column = start + np.arange(tiles)[:, None, None] * width + np.arange(wide)
        at = np.arange(count)[None, :, None] * columns + column
        names = ["n", "(k + p)" if parts > 1 else "k", "c"]
        if is_constant(factor):
            inside = np.broadcast_to(column < columns, at.shape)
            matrix = body.literal(np.where(inside, values(factor).ravel()[np.where(inside, at, 0)], 0), "real", names)
        else:
            matrix = body.read(factor, at, names)
        body.opened(f"for (int n = 0; n < {tiles}; ++n)")
        for number in range(len(rows)):
            body.line(f"real s{number}[{parts * wide}] = {{0}};")
        body.opened(f"for (int k = 0; k < {count}; k += {parts})")
        if parts > 1:
            body.opened(f"for (int p = 0; p < {parts}; ++p)")
        for number, (node, row) in enumerate(rows):
            body.line(f"const real x{number} = {body.read(node.args[0], row * count + np.arange(count), names[1:2])};")
        body.opened(f"for (int c = 0; c < {wide}; ++c)")
        body.line(f"const real w = {matrix};")
        for number in range(len(rows)):
            target = f"s{number}[{f'{wide} * p + c' if parts > 1 else 'c'}]"
            body.line(f"{target} = MULTIPLY_ADD(x{number}, w, {target});")
        for _ in range(3 if parts > 1 else 2):
            body.closed()
        body.opened(f"for (int c = 0; c < {width}; ++c)")
        for number, (node, row) in enumerate(rows):
            target = body.index(row * columns + column[:, 0, :width], ["n", "c"])
            total = " + ".join(f"s{number}[{f'{wide * part} + c' if part else 'c'}]" for part in range(parts))
            body.line(f"{body.name(node)}[{target}] = {total};")
        body.closed()
        body.closed()
        start += tiles * width


def _many(body, node: Node) -> None:
    """A product of many rows, or of a batch of matrices."""
    a, b = node.args
    (batch, m, count), columns = a.shape, b.shape[2]
    body.spend(2 * batch * m * count * columns)
    for start in range(0, columns, _TILE):
        width = min(_TILE, columns - start)
        index = [np.arange(extent) for extent in (batch, m, count, width)]
        i, j, k, c = np.meshgrid(*index, indexing="ij")
        names = ["b", "r", "k", "c"]
        body.opened(f"for (int b = 0; b < {batch}; ++b)")
        body.opened(f"for (int r = 0; r < {m}; ++r)")
        body.line(f"real s[{width}] = {{0}};")
        body.opened(f"for (int k = 0; k < {count}; ++k)")
        body.line(f"const real x = {body.read(a, ((i * m + j) * count + k)[..., 0], names[:3])};")
        body.opened(f"for (int c = 0; c < {width}; ++c)")
        text = body.read(b, ((i * count + k) * columns + start + c)[:, 0], ["b", "k", "c"])
        body.line(f"s[c] = MULTIPLY_ADD(x, {text}, s[c]);")
        body.closed()
        body.closed()
        target = body.index(((i * m + j) * columns + start + c)[:, :, 0], ["b", "r", "c"])
        body.line(f"for (int c = 0; c < {width}; ++c) {body.name(node)}[{target}] = s[c];")
        body.closed()
        body.closed()


def _dots(body, node: Node) -> None:
    """A product with one column."""
    a, b = node.args
    batch, m, count = a.shape
    body.spend(2 * batch * m * count)
    parts = 2 * _LANES[body.source.precision]
    parts = parts if count >= parts else 1
    whole = count // parts * parts
    i, j, k = np.meshgrid(np.arange(batch), np.arange(m), np.arange(count), indexing="ij")

    def both(index: str) -> str:
        first = body.read(a, (i * m + j) * count + k, ["b", "r", index])
        return f"MULTIPLY_ADD({first}, {body.read(b, (i * count + k)[:, 0], ['b', index])}"

    body.opened(f"for (int b = 0; b < {batch}; ++b)")
    body.opened(f"for (int r = 0; r < {m}; ++r)")
    body.line("real sum = 0;")
    if parts > 1:
        body.line(f"real part[{parts}] = {{0}};")
        body.opened(f"for (int k = 0; k < {whole}; k += {parts})")
        body.line(f"for (int c = 0; c < {parts}; ++c) part[c] = {both('(k + c)')}, part[c]);")
        body.closed()
        half = parts // 2
        while half:
            body.line(f"for (int c = 0; c < {half}; ++c) part[c] += part[c + {half}];")
            half //= 2
        body.line("sum = part[0];")
    if whole < count or parts == 1:
        body.line(f"for (int k = {whole if parts > 1 else 0}; k < {count}; ++k) sum = {both('k')}, sum);")
    body.line(f"{body.name(node)}[{body.index((i * m + j)[..., 0], ['b', 'r'])}] = sum;")
    body.closed()
    body.closed()
