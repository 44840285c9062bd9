"""What is no product and not elementwise as C: reductions, updates at indices, factorisations, and control flow."""

from textwrap import dedent

import numpy as np

from dln_jax.deploy.c.program import Loop, Node

_REDUCE = {
    "reduce_sum": ("{0} + {1}", 1),
    "reduce_prod": ("{0} * {1}", 1),
    "reduce_max": ("(({0} > {1} || {0} != {0}) ? {0} : {1})", 0),
    "reduce_min": ("(({0} < {1} || {0} != {0}) ? {0} : {1})", 0),
    "reduce_and": ("{0} & {1}", 0),
    "reduce_or": ("{0} | {1}", 0),
}
_OF_INTEGERS = {"reduce_max": "({0} > {1} ? {0} : {1})", "reduce_min": "({0} < {1} ? {0} : {1})"}
_PUT = {"put_set": "{1}", "put_add": "{0} + {1}", "put_sub": "{0} - {1}", "put_mul": "{0} * {1}"}
_PUT |= {f"put_{name}": _REDUCE[f"reduce_{name}"][0] for name in ("min", "max")}
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


def _pattern(node: Node) -> tuple[str, int]:
    """C of two terms of a reduction, and what it costs; integers are never NaN, as compilers know."""
    pattern, cost = _REDUCE[node.op]
    return (pattern, cost) if node.dtype == "real" else (_OF_INTEGERS.get(node.op, pattern), cost)


def combined(body, node: Node, k: int, terms: list[str]) -> str:
    """A reduction of few terms, written out."""
    pattern, cost = _pattern(node)
    body.spend(cost * (len(terms) - 1))
    text = terms[0]
    for place, term in enumerate(terms[1:]):
        text = f"({pattern.format(text, term)})"
        # A choice names what it compares twice: without a name of its own, its text doubles with each term.
        if node.op in ("reduce_max", "reduce_min") and place < len(terms) - 2:
            name = f"v{node.number}_{k}_{place}"
            body.line(f"const {body.c_type(node.dtype)} {name} = {text};")
            text = name
    return text


def written(body, node: Node) -> None:
    """The C of a node."""
    _WRITERS[node.op](body, node)


def _kept(body, node: Node) -> str:
    """Name of the array or scalar that is to hold a node."""
    if node in body.plan.arrays:
        return body.kept(node)
    body.declared(body.name(node), node.dtype, 0)
    return body.name(node)


def _reduction(body, node: Node) -> None:
    (a,) = node.args
    rows, count = a.shape
    pattern, cost = _pattern(node)
    body.spend(cost * rows * (count - 1))
    at, scalar = np.arange(a.size).reshape(a.shape), node not in body.plan.arrays
    name = _kept(body, node)
    parts = 8 if node.op == "reduce_sum" and node.dtype == "real" and count >= 16 else 1
    body.opened(f"for (int r_ = 0; r_ < {rows}; ++r_)")
    kind = body.c_type(node.dtype)
    whole = count // parts * parts
    if parts > 1:
        body.line(f"real part_[{parts}] = {{0}};")
        text = body.read(a, at, ["r_", "(k_ + c_)"])
        body.line(f"for (int k_ = 0; k_ < {whole}; k_ += {parts})")
        body.line(f"    for (int c_ = 0; c_ < {parts}; ++c_) part_[c_] += {text};")
        body.line(
            "real sum_ = (part_[0] + part_[4]) + (part_[1] + part_[5]) + ((part_[2] + part_[6]) + (part_[3] + part_[7]));"
        )
        if whole < count:
            body.line(f"for (int k_ = {whole}; k_ < {count}; ++k_) sum_ += {body.read(a, at, ['r_', 'k_'])};")
    else:
        body.line(f"{kind} sum_ = {body.read(a, at[:, 0], ['r_'])};")
        body.opened(f"for (int k_ = 1; k_ < {count}; ++k_)")
        body.line(f"const {kind} term_ = {body.read(a, at, ['r_', 'k_'])};")
        body.line(f"sum_ = {pattern.format('sum_', 'term_')};")
        body.closed()
    body.line(f"{name}{'' if scalar else '[r_]'} = sum_;")
    body.closed()


def _arg(body, node: Node) -> None:
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
    body.line(f"{name}{'' if scalar else '[r_]'} = chosen_;")
    body.closed()


def _put(body, node: Node) -> None:
    operand, targets, updates = node.args
    name, count = body.kept(node), updates.size
    body.copied(operand, name)
    body.spend(count)
    index = np.arange(count)
    body.opened(f"for (int k_ = 0; k_ < {count}; ++k_)")
    body.line(f"const long long target_ = {body.read(targets, index, ['k_'])};")
    body.line(f"const {body.c_type(node.dtype)} update_ = {body.read(updates, index, ['k_'])};")
    at = f"{name}[target_]"
    extreme = node.op.replace("put", "reduce") if node.dtype != "real" else ""
    pattern = _OF_INTEGERS.get(extreme, _PUT[node.op])
    body.line(f"if (target_ >= 0) {at} = {pattern.format(at, 'update_')};")
    body.closed()


def _cholesky(body, node: Node) -> None:
    (a,) = node.args
    n = a.shape[0]
    body.source.kernels.add("cholesky")
    body.kept(node)
    body.line(f"cholesky({n}, {body.pointer(a)}, {body.pointer(node)});")
    body.spend(n * (n + 1) * (n + 2) // 3)


def _triangular_solve(body, node: Node) -> None:
    a, b = node.args
    n, columns = b.shape
    lower, unit = map(int, node.attribute)
    body.source.kernels.add("triangular_solve")
    body.kept(node)
    sizes = f"{n}, {columns}, {lower}, {unit}"
    body.line(f"triangular_solve({sizes}, {body.pointer(a)}, {body.pointer(b)}, {body.pointer(node)});")
    body.spend(n * n * columns)


def _lu(body, node: Node) -> None:
    (a,) = node.args
    n, m = a.shape
    body.source.kernels.add("lu")
    names = [f"v{node.number}_{part}" for part in range(3)]
    for name, dtype, size in zip(names, ("real", "int", "int"), (n * m, min(n, m), n), strict=True):
        body.declared(name, dtype, size)
    body.line(f"lu({n}, {m}, {body.pointer(a)}, {', '.join(names)});")
    body.spend(2 * n * n * m // 3)


def _call(body, node: Node) -> None:
    part = body.part(node.attribute)
    names = [f"v{node.number}_{k}" for k in range(len(part.results))]
    for name, result in zip(names, part.results, strict=True):
        body.declared(name, result.dtype, max(result.size, 1))
    body.line(f"{part.name}({', '.join([*map(body.pointer, node.args), *names])});")
    body.spend(part.operations)


def _stored(body, node: Node, handed_on: list[Node], turns: list[int] | None = None) -> list[str]:
    """Declares what control flow hands on, and each of its turns leaves, whether it is read or not."""
    number = np.ravel(node.attribute)[0]
    read = body.projected(node)
    names = [f"c{number}_{index}" for index in range(len(handed_on))]
    for name, each, count in zip(names, handed_on, turns or [1] * len(names), strict=True):
        body.declared(name, each.dtype, max(each.size * count, 1))
    for name in (name for index, name in enumerate(names) if index not in read):
        body.line(f"(void){name};")
    return names


def _handed_on(body, loop: Loop, names: list[str], number: int) -> None:
    """New carries from the results of a turn, which may be old carries."""
    moved = loop.results[: len(names)]
    temporary = [f"n{number}_{index}" for index in range(len(moved))]
    for name, node in zip(temporary, moved, strict=True):
        body.declared(name, node.dtype, max(node.size, 1))
        body.copied(node, name)
    for name, old, node in zip(names, temporary, moved, strict=True):
        body.line(f"for (int k_ = 0; k_ < {node.size}; ++k_) {name}[k_] = {old}[k_];")


def _while(body, node: Node) -> None:
    number, loop = node.attribute, body.program.loops[node.attribute]
    names = _stored(body, node, loop.carries)
    for name, start in zip(names, node.args, strict=True):
        body.copied(start, name)
    region = (*node.region, number)
    body.opened("for (;;)")
    done: set[Node] = set()
    body.region(region, done, body.ancestors(loop.conditions))
    body.line(f"if (!{body.read(loop.conditions[0], np.array(0))}) break;")
    body.region(region, done)
    _handed_on(body, loop, names, number)
    body.closed()


def _repeat(body, node: Node) -> None:
    number, loop = node.attribute, body.program.loops[node.attribute]
    length, carried = int(loop.length or 0), len(loop.carries)
    stacked = loop.results[carried:]
    names = _stored(body, node, [*loop.carries, *stacked], [1] * carried + [length] * len(stacked))[:carried]
    for name, start in zip(names, node.args, strict=True):
        body.copied(start, name)
    read = body.projected(node)
    stacked = {carried + k: each for k, each in enumerate(loop.results[carried:]) if carried + k in read}
    turn = f"{length - 1} - t{number}" if loop.reverse else f"t{number}"
    body.opened(f"for (int t{number} = 0; t{number} < {length}; ++t{number})", max(length, 1))
    if stacked or any(each.op == "counter" and each.attribute == number for each in body.plan.needed):
        body.line(f"const long long i_{number} = {turn};")
    body.region((*node.region, number))
    for index, each in stacked.items():
        body.opened("")
        body.declared(f"n{number}_{index}", each.dtype, max(each.size, 1))
        body.copied(each, f"n{number}_{index}")
        target = f"c{number}_{index}[i_{number} * {each.size} + k_]"
        body.line(f"for (int k_ = 0; k_ < {each.size}; ++k_) {target} = n{number}_{index}[k_];")
        body.closed()
    _handed_on(body, loop, names, number)
    body.closed(max(length, 1))


def _branch(body, node: Node) -> None:
    numbers = node.attribute
    names = _stored(body, node, body.program.loops[numbers[0]].results)
    which = body.read(node.args[0], np.array(0))
    for place, number in enumerate(numbers):
        last = place == len(numbers) - 1
        test = f"if ({which} {'<=' if place == 0 else '=='} {place})"
        body.opened(("else " if place else "") + ("" if last else test))
        body.region((*node.region, number))
        for index, (name, result) in enumerate(zip(names, body.program.loops[number].results, strict=True)):
            if index in body.projected(node):
                body.copied(result, name)
        body.closed()


_WRITERS = {
    **dict.fromkeys(_REDUCE, _reduction),
    **dict.fromkeys(_PUT, _put),
    "argmax": _arg,
    "argmin": _arg,
    "cholesky": _cholesky,
    "triangular_solve": _triangular_solve,
    "lu": _lu,
    "call": _call,
    "while": _while,
    "repeat": _repeat,
    "branch": _branch,
}
