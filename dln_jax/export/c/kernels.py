"""C text of products, reductions, scattered updates and sorts; see `factorisations` for functions of matrices."""

from collections.abc import Callable
from string import Template

import numpy as np

from dln_jax.export.c import factorisations
from dln_jax.export.c.body import Body
from dln_jax.export.c.elements import combination, copied
from dln_jax.export.c.nodes import Node, is_constant, values
from dln_jax.export.c.operations import OPERATIONS, expression
from dln_jax.export.c.text import C_TYPES

_LANES = {"f64": 4, "f32": 8}
_TILE = 64
"""Number of columns summed at once; gcc allocates registers better for wide blocks."""
_ROWS = 16
"""Largest number of rows with separate sums; more rows are a loop over rows."""
ORDER = Template("""
/* Places of each row's elements [rows, n] in ascending order, equal ones as they were, by merging; NaN last */
static inline int elementary_before_$kind($c x, $c y)
{
    return !(y <= x) && +x == +x;
}

static void elementary_order_$kind(int rows, int n, const $c *key, long long *merged, long long *order)
{
    for (int row = 0; row < rows; ++row, order += n) {
        for (int k = 0; k < n; ++k) order[k] = (long long)row * n + k;
        for (long long width = 1; width < n; width *= 2) {
            for (long long first = 0; first < n; first += 2 * width) {
                const long long middle = first + width < n ? first + width : n;
                const long long last = middle + width < n ? middle + width : n;
                long long i = first, j = middle;
                for (long long k = first; k < last; ++k) {
                    const int second = j < last
                        && (i == middle || elementary_before_$kind(key[order[j]], key[order[i]]));
                    merged[k] = second ? order[j++] : order[i++];
                }
            }
            for (int k = 0; k < n; ++k) order[k] = merged[k];
        }
    }
}
""")


def dot_general(body: Body, members: list[Node]) -> None:
    """Writes the products of several matrices with the same second matrix.

    Every loop keeps a block of sums in registers, side by side along the contiguous axis of the second matrix. Products
    with the same constant share one loop, so a value and its tangents pass through a network layer together. The
    constant is stored in the order of the loop. A product with one column splits its sums into parts.
    """
    for node in members:
        body.kept(node)
    batch, _, columns = members[0].args[1].shape
    real = members[0].dtype == "real"
    if real and columns == 1:
        for node in members:
            _dots(body, node)
        return
    small = [node for node in members if real and batch == 1 and node.shape[1] <= _ROWS]
    rows = [(node, np.array([[row]])) for node in small for row in range(node.shape[1])]
    while rows:
        blocks = -(-len(rows) // 4)
        size = -(-len(rows) // blocks)
        _block(body, rows[:size])
        rows = rows[size:]
    for node in members:
        if node not in small:
            row = np.arange(batch * node.shape[1]).reshape(batch, -1)
            with body.loops({"b_": batch, "r_": node.shape[1]}):
                _block(body, [(node, row)])


def _parts(rows: int, columns: int, count: int) -> int:
    """Returns the number of partial sums per column: with few columns, several sums hide the latency of additions."""
    parts = {1: 4 if columns <= 32 else 1, 2: 2 if columns <= 16 else 1}.get(rows, 1)
    while count % parts:
        parts //= 2
    return parts


def _block(body: Body, rows: list[tuple[Node, np.ndarray]]) -> None:
    """Writes rows of products with one matrix: single rows, or loops over a batch and its rows."""
    factor, kind = rows[0][0].args[1], rows[0][0].dtype
    batch, count, columns = factor.shape
    body.spend(multiply_add=len(rows) * count * columns * (kind == "real"))
    start = 0
    while start < columns:
        width = min(_TILE, columns - start)
        tiles = (columns - start) // width
        # Constants are padded to whole vectors.
        lanes = _LANES[body.source.precision]
        wide = -(-width // lanes) * lanes if is_constant(factor) else width
        parts = _parts(sum(at.size for _, at in rows), wide, count) if kind == "real" else 1
        term = "(k_ + p_)" if parts > 1 else "k_"
        column = start + np.arange(tiles)[:, None, None] * width + np.arange(wide)
        at = (np.arange(batch)[:, None, None, None] * count + np.arange(count)[:, None]) * columns + column
        names = ["b_", "n_", term, "c_"]
        if is_constant(factor):
            inside = np.broadcast_to(column < columns, at.shape)
            matrix = body.literal(np.where(inside, values(factor).ravel()[np.where(inside, at, 0)], 0), kind, names)
        else:
            matrix = body.read(factor, at, names)
        with body.loops({"n_": tiles}):
            for number in range(len(rows)):
                body.declared(f"s{number}_", kind, parts * wide, "{0}")
            parted = {"p_": parts} if parts > 1 else {}
            with body.block(f"for (int k_ = 0; k_ < {count}; k_ += {parts})"), body.loops(parted):
                for number, (node, row) in enumerate(rows):
                    text = body.read(node.args[0], row[..., None] * count + np.arange(count), ["b_", "r_", term])
                    body.line(f"const {C_TYPES[kind]} x{number}_ = {text};")
                with body.loops({"c_": wide}):
                    body.line(f"const {C_TYPES[kind]} w_ = {matrix};")
                    for number in range(len(rows)):
                        target = f"s{number}_[{f'{wide} * p_ + c_' if parts > 1 else 'c_'}]"
                        body.line(f"{target} = {expression('multiply_add', kind, f'x{number}_', 'w_', target)};")
            with body.loops({"c_": width}):
                for number, (node, row) in enumerate(rows):
                    of_result = row[..., None, None] * columns + column[:, 0, :width]
                    target = body.index(of_result, ["b_", "r_", "n_", "c_"])
                    total = " + ".join(
                        f"s{number}_[{f'{wide * part} + c_' if part else 'c_'}]" for part in range(parts)
                    )
                    body.line(f"{body.name(node)}[{target}] = {total};")
        start += tiles * width


def _dots(body: Body, node: Node) -> None:
    """Writes a product with one column."""
    a, b = node.args
    batch, m, count = a.shape
    body.spend(multiply_add=batch * m * count)
    parts = 2 * _LANES[body.source.precision]
    of_a, of_b, of_result = (np.arange(one.size).reshape(one.shape) for one in (a, b, node))

    def add(index: str, total: str) -> str:
        first, second = body.read(a, of_a, ["b_", "r_", index]), body.read(b, of_b[..., 0], ["b_", index])
        return f"MULTIPLY_ADD({first}, {second}, {total})"

    with body.loops({"b_": batch, "r_": m}):
        summed(body, count, parts, add)
        body.line(f"{body.name(node)}[{body.index(of_result[..., 0], ['b_', 'r_'])}] = sum_;")


def summed(body: Body, count: int, parts: int, add: Callable[[str, str], str]) -> None:
    """Declares a real `sum_` of `count` terms, computed in vectorisable partial sums.

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


def _reduction(body: Body, node: Node) -> None:
    (a,) = node.args
    rows, count = a.shape
    combine, op = combination(node), node.op.partition("_")[2]
    body.spend(**{op: rows * (count - 1)} if node.dtype == "real" else {})
    at, kind = np.arange(a.size).reshape(a.shape), C_TYPES[node.dtype]
    if node in body.plan.arrays:
        target = f"{body.kept(node)}[r_]"
    else:
        target = body.name(node)
        body.declared(target, node.dtype, 0)
    with body.loops({"r_": rows}):
        if node.op == "reduce_add" and node.dtype == "real" and count >= 16:
            summed(body, count, 8, lambda k, total: f"{total} + {body.read(a, at, ['r_', k])}")
        else:
            body.line(f"{kind} sum_ = {body.read(a, at[:, 0], ['r_'])};")
            with body.block(f"for (int k_ = 1; k_ < {count}; ++k_)"):
                body.line(f"const {kind} term_ = {body.read(a, at, ['r_', 'k_'])};")
                body.line(f"sum_ = {combine('sum_', 'term_')};")
        body.line(f"{target} = sum_;")


def _put(body: Body, node: Node) -> None:
    operand, targets, updates = node.args
    name, count = body.kept(node), updates.size
    copied(body, operand, name)
    index, at = np.arange(count), f"{name}[target_]"
    op = node.op.partition("_")[2]
    body.spend(**{op: count} if op in OPERATIONS and node.dtype == "real" else {})
    with body.loops({"k_": count}):
        body.line(f"const long long target_ = {body.read(targets, index, ['k_'])};")
        body.line(f"const {C_TYPES[node.dtype]} update_ = {body.read(updates, index, ['k_'])};")
        new = "update_" if node.op == "put_set" else combination(node)(at, "update_")
        body.line(f"if (target_ >= 0) {at} = {new};")


def _order(body: Body, node: Node) -> None:
    (key,) = node.args
    rows, n = node.shape
    merged = f"v{node.number}_merged"
    body.declared(merged, "index", n)
    target = body.kept(node)
    body.line(f"elementary_order_{key.dtype}({rows}, {n}, {body.pointer(key)}, {merged}, {target});")


WRITERS = {
    **{f"reduce_{op}": _reduction for op in ("add", "mul", "max", "min", "and", "or", "xor")},
    **{f"put_{op}": _put for op in ("set", "add", "sub", "mul", "min", "max")},
    "order": _order,
    **factorisations.WRITERS,
}
"""Functions that write a node, by its operation."""
