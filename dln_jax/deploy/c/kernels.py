"""What is no product and not elementwise as C: reductions, updates at indices, factorisations, and control flow."""

from collections.abc import Callable
from functools import partial
from textwrap import dedent

import numpy as np

from dln_jax.deploy.c.body import Body
from dln_jax.deploy.c.moves import copied
from dln_jax.deploy.c.nodes import Node
from dln_jax.deploy.c.operations import OPERATIONS, written

_REDUCE = tuple(f"reduce_{op}" for op in ("add", "mul", "max", "min", "and", "or", "xor"))
_PUT = tuple(f"put_{op}" for op in ("set", "add", "sub", "mul", "min", "max"))
FUNCTIONS = {
    "cholesky": """
    /* Lower triangular l with l l^T = a [n, n]; all NaN where a is not positive definite */
    static void cholesky(int n, const real *a, real *l)
    {
        int definite = 1; /* a NaN reaches what depends on it */
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j) {
                real rest = a[i * n + j];
                if (j > i) {
                    l[i * n + j] = 0;
                    continue;
                }
                for (int k = 0; k < j; ++k) rest -= l[i * n + k] * l[j * n + k];
                l[i * n + j] = i == j ? SQRT(rest) : rest / l[j * n + j];
                definite &= i != j || !(rest <= 0);
            }
        for (int i = 0; !definite && i < n * n; ++i) l[i] = (real)NAN;
    }
    """,
    "triangular_solve": """
    /* x [n, columns] with a x = b, a lower or upper triangular */
    static void triangular_solve(int n, int columns, int lower, int unit, const real *a, const real *b, real *x)
    {
        for (int turn = 0; turn < n; ++turn) {
            const int i = lower ? turn : n - 1 - turn;
            for (int c = 0; c < columns; ++c) {
                real rest = b[i * columns + c];
                for (int j = lower ? 0 : i + 1; j < (lower ? i : n); ++j) rest -= a[i * n + j] * x[j * columns + c];
                x[i * columns + c] = unit ? rest : rest / a[i * n + i];
            }
        }
    }
    """,
    "lu": """
    /* Factors of rows of a [n, m] by elimination with partial pivoting: packed, row exchanged at each step, order */
    static void lu(int n, int m, const real *a, real *packed, int *pivots, int *order)
    {
        for (int i = 0; i < n * m; ++i) packed[i] = a[i];
        for (int i = 0; i < n; ++i) order[i] = i;
        for (int k = 0; k < n && k < m; ++k) {
            int pivot = k;
            for (int i = k + 1; i < n; ++i)
                if (FABS(packed[i * m + k]) > FABS(packed[pivot * m + k])) pivot = i;
            pivots[k] = pivot;
            if (pivot != k) {
                const int moved = order[k];
                order[k] = order[pivot];
                order[pivot] = moved;
                for (int j = 0; j < m; ++j) {
                    const real swapped = packed[k * m + j];
                    packed[k * m + j] = packed[pivot * m + j];
                    packed[pivot * m + j] = swapped;
                }
            }
            for (int i = k + 1; i < n; ++i) {
                packed[i * m + k] /= packed[k * m + k];
                for (int j = k + 1; j < m; ++j) packed[i * m + j] -= packed[i * m + k] * packed[k * m + j];
            }
        }
    }
    """,
}
"""C functions that are put into a source that needs them."""


def definitions(names: set[str], suffix: str) -> str:
    """Text of these functions."""
    text = "".join("\n" + dedent(FUNCTIONS[name]).strip() + "\n" for name in FUNCTIONS if name in names)
    return text.replace("SQRT(", f"sqrt{suffix}(").replace("FABS(", f"fabs{suffix}(")


def _joined(node: Node) -> tuple[Callable[..., str], int]:
    """C of two terms of a reduction or update, and its floating-point operations."""
    op = node.op.partition("_")[2]
    return partial(written, op, node.dtype), OPERATIONS[op].cost * (node.dtype == "real")


def combined(body: Body, node: Node, k: int, terms: list[str]) -> str:
    """A reduction of few terms, written out."""
    joined, cost = _joined(node)
    body.spend(cost * (len(terms) - 1))
    text = terms[0]
    for place, term in enumerate(terms[1:]):
        text = joined(text, term)
        # A choice names what it compares twice: without a name of its own, its text doubles with each term.
        if node.op in ("reduce_max", "reduce_min") and place < len(terms) - 2:
            name = f"v{node.number}_{k}_{place}"
            body.line(f"const {body.c_type(node.dtype)} {name} = {text};")
            text = name
    return text


def _kept(body: Body, node: Node) -> str:
    """Name of the array or scalar that is to hold a node."""
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
    kind = body.c_type(node.dtype)
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
    """The first of the largest or smallest; what is not a number comes before all."""
    (a,) = node.args
    rows, count = a.shape
    at, scalar, kind = np.arange(a.size).reshape(a.shape), node not in body.plan.arrays, body.c_type(a.dtype)
    name = _kept(body, node)
    body.opened(f"for (int r_ = 0; r_ < {rows}; ++r_)")
    body.line("int chosen_ = 0;")
    body.line(f"{kind} best_ = {body.read(a, at[:, 0], ['r_'])};")
    body.opened(f"for (int k_ = 1; k_ < {count}; ++k_)")
    body.line(f"const {kind} x_ = {body.read(a, at, ['r_', 'k_'])};")
    symbol = ">" if node.op == "argmax" else "<"
    unordered = a.dtype == "real"  # where the first NaN is the one
    body.opened(f"if ((x_ {symbol} best_ || x_ != x_) && best_ == best_)" if unordered else f"if (x_ {symbol} best_)")
    body.line("best_ = x_;")
    body.line("chosen_ = k_;")
    body.closed()
    body.closed()
    body.line(f"{name}{'' if scalar else '[r_]'} = ({body.c_type(node.dtype)})chosen_;")
    body.closed()


def _put(body: Body, node: Node) -> None:
    operand, targets, updates = node.args
    name, count = body.kept(node), updates.size
    copied(body, operand, name)
    body.spend(count)
    index = np.arange(count)
    body.opened(f"for (int k_ = 0; k_ < {count}; ++k_)")
    body.line(f"const long long target_ = {body.read(targets, index, ['k_'])};")
    body.line(f"const {body.c_type(node.dtype)} update_ = {body.read(updates, index, ['k_'])};")
    at = f"{name}[target_]"
    new = "update_" if node.op == "put_set" else _joined(node)[0](at, "update_")
    body.line(f"if (target_ >= 0) {at} = {new};")
    body.closed()


def _cholesky(body: Body, node: Node) -> None:
    (a,) = node.args
    n = a.shape[0]
    body.source.kernels.add("cholesky")
    body.kept(node)
    body.line(f"cholesky({n}, {body.pointer(a)}, {body.pointer(node)});")
    body.spend(n * (n + 1) * (n + 2) // 3)


def _triangular_solve(body: Body, node: Node) -> None:
    a, b = node.args
    n, columns = b.shape
    lower, unit = map(int, node.attribute)
    body.source.kernels.add("triangular_solve")
    body.kept(node)
    sizes = f"{n}, {columns}, {lower}, {unit}"
    body.line(f"triangular_solve({sizes}, {body.pointer(a)}, {body.pointer(b)}, {body.pointer(node)});")
    body.spend(n * n * columns)


def _lu(body: Body, node: Node) -> None:
    (a,) = node.args
    n, m = a.shape
    body.source.kernels.add("lu")
    names = [f"v{node.number}_{part}" for part in range(3)]
    for name, dtype, size in zip(names, ("real", "int", "int"), (n * m, min(n, m), n), strict=True):
        body.declared(name, dtype, size)
    body.line(f"lu({n}, {m}, {body.pointer(a)}, {', '.join(names)});")
    body.spend(2 * n * n * m // 3)


WRITERS = {
    **dict.fromkeys(_REDUCE, _reduction),
    **dict.fromkeys(_PUT, _put),
    "argmax": _arg,
    "argmin": _arg,
    "cholesky": _cholesky,
    "triangular_solve": _triangular_solve,
    "lu": _lu,
}
