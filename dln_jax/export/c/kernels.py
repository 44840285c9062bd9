"""C of reductions, scattered updates and sorts; functions on matrices are in `factorisations`."""

import re
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

_PREFIX = "order_"
_ORDER = Template("""
/* Places of each row's elements [rows, n] in ascending order of their keys, by merging; NaN last */
static inline int ${name}_before(long long i, long long j$keys)
{
$comparisons    return 0;
}

static void $name(int rows, int n, long long *merged, long long *order$keys)
{
    for (int row = 0; row < rows; ++row, order += n) {
        for (int k = 0; k < n; ++k) order[k] = (long long)row * n + k;
        for (long long width = 1; width < n; width *= 2) {
            for (long long first = 0; first < n; first += 2 * width) {
                const long long middle = first + width < n ? first + width : n;
                const long long last = middle + width < n ? middle + width : n;
                long long i = first, j = middle;
                for (long long k = first; k < last; ++k) {
                    const int second = i == middle || (j < last && ${name}_before(order[j], order[i]$passed));
                    merged[k] = second ? order[j++] : order[i++];
                }
            }
            for (int k = 0; k < n; ++k) order[k] = merged[k];
        }
    }
}
""")


def orderings(names: Collection[str]) -> str:
    """Returns the C functions with these names, which sort by keys of the kinds in it, the first taking precedence."""
    text = ""
    for name in sorted(name for name in names if name.startswith(_PREFIX)):
        kinds = re.findall("|".join(sorted(C_TYPES, key=len, reverse=True)), name.removeprefix(_PREFIX))
        comparisons = ""
        for place, kind in enumerate(kinds):
            for first, second, before in (("i", "j", 1), ("j", "i", 0)):
                a, b = f"key{place}[{first}]", f"key{place}[{second}]"
                nan_last = f" || ({a} == {a} && {b} != {b})" if kind == "real" else ""
                comparisons += f"    if ({a} < {b}{nan_last}) return {before};\n"
        keys = "".join(f", const {C_TYPES[kind]} *key{place}" for place, kind in enumerate(kinds))
        passed = "".join(f", key{place}" for place in range(len(kinds)))
        text += _ORDER.substitute(name=f"elementary_{name}", keys=keys, passed=passed, comparisons=comparisons)
    return text


def _reduction(body: Body, node: Node) -> None:
    (a,) = node.args
    rows, count = a.shape
    combine, op = combination(node), node.op.partition("_")[2]
    body.spend(**{op: rows * (count - 1)} if node.dtype == "real" else {})
    at, kind = np.arange(a.size).reshape(a.shape), C_TYPES[node.dtype]
    target = _kept(body, node)
    with body.loops({"r_": rows}):
        if node.op == "reduce_add" and node.dtype == "real" and count >= 16:
            summed(body, count, 8, lambda k, total: f"{total} + {body.read(a, at, ['r_', k])}")
        else:
            body.line(f"{kind} sum_ = {body.read(a, at[:, 0], ['r_'])};")
            with body.block(f"for (int k_ = 1; k_ < {count}; ++k_)"):
                body.line(f"const {kind} term_ = {body.read(a, at, ['r_', 'k_'])};")
                body.line(f"sum_ = {combine('sum_', 'term_')};")
        body.line(f"{target} = sum_;")


def _arg(body: Body, node: Node) -> None:
    """Writes argmax or argmin: the first extremum, or the first NaN if there is one."""
    (a,) = node.args
    rows, count = a.shape
    at, kind, better = np.arange(a.size).reshape(a.shape), C_TYPES[a.dtype], ">" if node.op == "argmax" else "<"
    test = f"x_ {better} best_"
    if a.dtype == "real":  # only real numbers may be NaN
        test = f"({test} || x_ != x_) && best_ == best_"
    target = _kept(body, node)
    with body.loops({"r_": rows}):
        body.line("int chosen_ = 0;")
        body.line(f"{kind} best_ = {body.read(a, at[:, 0], ['r_'])};")
        with body.block(f"for (int k_ = 1; k_ < {count}; ++k_)"):
            body.line(f"const {kind} x_ = {body.read(a, at, ['r_', 'k_'])};")
            with body.block(f"if ({test})"):
                body.line("best_ = x_;")
                body.line("chosen_ = k_;")
        body.line(f"{target} = ({C_TYPES[node.dtype]})chosen_;")


def _kept(body: Body, node: Node) -> str:
    """Declares the array or scalar for a node, and returns the C of its element in row `r_`."""
    if node in body.plan.arrays:
        return f"{body.kept(node)}[r_]"
    body.declared(body.name(node), node.dtype, 0)
    return body.name(node)


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
    """Writes a call of the function that sorts by the keys of a node."""
    rows, n = node.shape
    name, merged = _PREFIX + "_".join(key.dtype for key in node.args), f"v{node.number}_merged"
    body.declared(merged, "index", n)
    target = body.kept(node)
    body.line(f"elementary_{name}({rows}, {n}, {merged}, {target}, {', '.join(map(body.pointer, node.args))});")


WRITERS = {
    **{f"reduce_{op}": _reduction for op in ("add", "mul", "max", "min", "and", "or", "xor")},
    **{f"put_{op}": _put for op in ("set", "add", "sub", "mul", "min", "max")},
    "argmax": _arg,
    "argmin": _arg,
    "order": _order,
    **factorisations.WRITERS,
}
"""Functions that write a node, by its operation."""
