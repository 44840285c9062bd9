"""C of reductions and of scattered updates; sorting and factorisations have modules of their own."""

from collections.abc import Callable
from functools import partial

import numpy as np

from dln_jax.export.c import factorisations, ordering
from dln_jax.export.c.body import Body
from dln_jax.export.c.kinds import C_TYPES
from dln_jax.export.c.moves import copied
from dln_jax.export.c.nodes import Node
from dln_jax.export.c.operations import OPERATIONS, expression

_REDUCE = tuple(f"reduce_{op}" for op in ("add", "mul", "max", "min", "and", "or", "xor"))
_PUT = tuple(f"put_{op}" for op in ("set", "add", "sub", "mul", "min", "max"))


def _joined(node: Node) -> tuple[Callable[..., str], int]:
    """Returns a function that gives the C of two combined terms, and its floating-point operations."""
    op = node.op.partition("_")[2]
    return partial(expression, op, node.dtype), OPERATIONS[op].cost * (node.dtype == "real")


def combined(body: Body, node: Node, k: int, terms: list[str]) -> str:
    """Returns the C of an unrolled reduction."""
    joined, cost = _joined(node)
    body.spend(cost * (len(terms) - 1))
    text = terms[0]
    for place, term in enumerate(terms[1:]):
        text = joined(text, term)
        # The C of max and min repeats its operands: without a variable, the text would double with every term.
        if node.op in ("reduce_max", "reduce_min") and place < len(terms) - 2:
            name = f"v{node.number}_{k}_{place}"
            body.line(f"const {C_TYPES[node.dtype]} {name} = {text};")
            text = name
    return text


def _kept(body: Body, node: Node) -> str:
    """Returns the name of the array or scalar for a node, declared."""
    if node in body.plan.arrays:
        return body.kept(node)
    body.declared(body.name(node), node.dtype, 0)
    return body.name(node)


def _reduction(body: Body, node: Node) -> None:
    (a,) = node.args
    rows, count = a.shape
    joined, cost = _joined(node)
    body.spend(cost * rows * (count - 1))
    at, scalar = np.arange(a.size).reshape(a.shape), node not in body.plan.arrays
    name = _kept(body, node)
    parts = 8 if node.op == "reduce_add" and node.dtype == "real" and count >= 16 else 1
    body.opened(f"for (int r_ = 0; r_ < {rows}; ++r_)")
    kind = C_TYPES[node.dtype]
    whole = count // parts * parts
    if parts > 1:
        body.line(f"real part_[{parts}] = {{0}};")
        text = body.read(a, at, ["r_", "(k_ + c_)"])
        body.line(f"for (int k_ = 0; k_ < {whole}; k_ += {parts})")
        body.line(f"    for (int c_ = 0; c_ < {parts}; ++c_) part_[c_] += {text};")
        body.line("for (int c_ = 0; c_ < 4; ++c_) part_[c_] += part_[c_ + 4];")
        body.line("real sum_ = (part_[0] + part_[1]) + (part_[2] + part_[3]);")
        if whole < count:
            body.line(f"for (int k_ = {whole}; k_ < {count}; ++k_) sum_ += {body.read(a, at, ['r_', 'k_'])};")
    else:
        body.line(f"{kind} sum_ = {body.read(a, at[:, 0], ['r_'])};")
        body.opened(f"for (int k_ = 1; k_ < {count}; ++k_)")
        body.line(f"const {kind} term_ = {body.read(a, at, ['r_', 'k_'])};")
        body.line(f"sum_ = {joined('sum_', 'term_')};")
        body.closed()
    body.line(f"{name}{'' if scalar else '[r_]'} = sum_;")
    body.closed()


def _arg(body: Body, node: Node) -> None:
    """Writes argmax or argmin: the first extreme, or the first NaN if there is one."""
    (a,) = node.args
    rows, count = a.shape
    at, scalar, kind = np.arange(a.size).reshape(a.shape), node not in body.plan.arrays, C_TYPES[a.dtype]
    name = _kept(body, node)
    body.opened(f"for (int r_ = 0; r_ < {rows}; ++r_)")
    body.line("int chosen_ = 0;")
    body.line(f"{kind} best_ = {body.read(a, at[:, 0], ['r_'])};")
    body.opened(f"for (int k_ = 1; k_ < {count}; ++k_)")
    body.line(f"const {kind} x_ = {body.read(a, at, ['r_', 'k_'])};")
    symbol = ">" if node.op == "argmax" else "<"
    unordered = a.dtype == "real"  # only real numbers may be NaN
    body.opened(f"if ((x_ {symbol} best_ || x_ != x_) && best_ == best_)" if unordered else f"if (x_ {symbol} best_)")
    body.line("best_ = x_;")
    body.line("chosen_ = k_;")
    body.closed()
    body.closed()
    body.line(f"{name}{'' if scalar else '[r_]'} = ({C_TYPES[node.dtype]})chosen_;")
    body.closed()


def _put(body: Body, node: Node) -> None:
    operand, targets, updates = node.args
    name, count = body.kept(node), updates.size
    copied(body, operand, name)
    body.spend(count)
    index = np.arange(count)
    body.opened(f"for (int k_ = 0; k_ < {count}; ++k_)")
    body.line(f"const long long target_ = {body.read(targets, index, ['k_'])};")
    body.line(f"const {C_TYPES[node.dtype]} update_ = {body.read(updates, index, ['k_'])};")
    at = f"{name}[target_]"
    new = "update_" if node.op == "put_set" else _joined(node)[0](at, "update_")
    body.line(f"if (target_ >= 0) {at} = {new};")
    body.closed()


WRITERS = {
    **dict.fromkeys(_REDUCE, _reduction),
    **dict.fromkeys(_PUT, _put),
    "argmax": _arg,
    "argmin": _arg,
    "order": ordering.order,
    **factorisations.WRITERS,
}
