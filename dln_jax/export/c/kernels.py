"""C of reductions, scattered updates and sorts; functions on matrices are in `factorisations`."""

from collections.abc import Collection
from string import Template

import numpy as np

from dln_jax.export.c import factorisations
from dln_jax.export.c.body import Body
from dln_jax.export.c.elements import combination, copied
from dln_jax.export.c.nodes import Node
from dln_jax.export.c.operations import OPERATIONS
from dln_jax.export.c.products import summed
from dln_jax.export.c.text import C_TYPES

_ORDER = Template("""
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


def orderings(names: Collection[str]) -> str:
    """Returns the C functions with these names, which sort by keys of a kind."""
    return "".join(_ORDER.substitute(kind=kind, c=c) for kind, c in C_TYPES.items() if f"order_{kind}" in names)


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
