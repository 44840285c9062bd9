"""Rules that lower JAX's elementwise and shape primitives, products and reductions to nodes of a program.

A rule takes the program, the equation's arguments and, by keyword, the parameters that it reads, and returns one or
several results. Two more keywords are `results`, the abstract values of the results, and `kind`, that of the first.
"""

import functools
from collections.abc import Callable
from math import prod
from typing import Any

import numpy as np
from jax import lax

from dln_jax.export.c.nodes import Node, zeros
from dln_jax.export.c.operations import on_kind
from dln_jax.export.c.program import Program
from dln_jax.export.c.simplify import UNROLL_LIMIT, neutral
from dln_jax.export.c.text import NUMPY_TYPES, UNSIGNED
from dln_jax.types import InputError

Rule = Callable[..., Any]
_AS_NAMED = (
    "add", "sub", "mul", "div", "rem", "max", "min", "neg", "abs", "not", "and", "or", "xor", "atan2", "sqrt", "cbrt",
    "exp", "exp2", "expm1", "log", "log1p", "log2", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh",
    "asinh", "acosh", "atanh", "erf", "erfc", "lgamma", "floor", "ceil", "is_finite", "nextafter", "shift_left",
    "shift_right_logical", "shift_right_arithmetic",
)  # fmt: skip


def convert(program: Program, node: Node, kind: str) -> Node:
    """Returns the node converted to a kind."""
    return node if node.dtype == kind else program.elementwise(f"to_{kind}", node)


def rows_of(program: Program, node: Node, axes: tuple[int, ...]) -> Node:
    """Returns the node as a matrix [o, r] whose columns are the elements along `axes`."""
    kept = [axis for axis in range(len(node.shape)) if axis not in axes]
    index = np.arange(node.size).reshape(node.shape).transpose([*kept, *axes])
    return program.gather([node], index.reshape(prod(node.shape[axis] for axis in kept), -1))


def _elementwise(name: str) -> Rule:
    return lambda program, *args: program.elementwise(name, *args)


def _moved(move: Callable[..., Any]) -> Rule:
    """Returns the rule of a primitive that only moves elements.

    `move` takes one array of element indices per argument, and the parameters; returns those of the results.
    """

    @functools.wraps(move)
    def rule(program: Program, *nodes: Node, **parameters: Any) -> Any:
        starts = np.cumsum([0, *(node.size for node in nodes)])
        indices = [np.arange(node.size).reshape(node.shape) + k for node, k in zip(nodes, starts, strict=False)]
        moved = move(*indices, **parameters)
        if isinstance(moved, list):
            return [program.gather(nodes, positions) for positions in moved]
        return program.gather(nodes, moved)

    return rule


def _broadcast_in_dim(index, *, shape, broadcast_dimensions):
    expanded = [1] * len(shape)
    for axis, size in zip(broadcast_dimensions, index.shape, strict=True):
        expanded[axis] = size
    return np.broadcast_to(index.reshape(expanded), shape)


def _slice(index, *, start_indices, limit_indices, strides):
    limits = zip(start_indices, limit_indices, strides or [1] * index.ndim, strict=True)
    return index[tuple(slice(int(start), int(limit), int(stride)) for start, limit, stride in limits)]


def _pad(index, padding, *, padding_config):
    for axis, (low, high, interior) in enumerate(padding_config):
        step, extent = int(interior) + 1, index.shape[axis]
        place = np.arange(-int(low), max((extent - 1) * step + 1, 0) + int(high))
        chosen = np.where((place % step == 0) & (place >= 0), np.minimum(place // step, extent), extent)
        sides = [(0, int(other == axis)) for other in range(index.ndim)]
        index = np.pad(index, sides, constant_values=padding).take(chosen, axis)
    return index


def _split(index, *, sizes, axis):
    return list(np.split(index, np.cumsum(sizes)[:-1], axis=axis))


def _comparison(name: str) -> Rule:
    """Returns the rule of a comparison; booleans use logic, because compilers warn about comparing them."""

    def rule(program: Program, a: Node, b: Node) -> Node:
        if a.dtype != "bool" or name == "ne":
            return program.elementwise(name, a, b)
        if name == "eq":
            return program.elementwise("not", program.elementwise("xor", a, b))
        # a < b is (not a) and b; a <= b is (not a) or b
        low, high = (a, b) if name in ("lt", "le") else (b, a)
        return program.elementwise("and" if name in ("lt", "gt") else "or", program.elementwise("not", low), high)

    return rule


def _total_order(name: str) -> Rule:
    """Returns the rule of a comparison in the total order of IEEE 754; other kinds are compared as usual."""
    usual = _comparison(name)

    def rule(program: Program, a: Node, b: Node) -> Node:
        return program.elementwise(f"{name}_to", a, b) if a.dtype == "real" else usual(program, a, b)

    return rule


def _power(program: Program, x: Node, exponent: Node, *, kind: str) -> Node:
    return program.elementwise("pow", *(convert(program, node, kind) for node in (x, exponent)))


def _integer_power(program: Program, x: Node, *, y: int) -> Node:
    result, power, left = None, x, abs(y)
    while left:
        if left & 1:
            result = power if result is None else program.elementwise("mul", result, power)
        left >>= 1
        power = program.elementwise("mul", power, power) if left else power
    one = program.constant(1, x.dtype)
    if result is None:
        return program.broadcast(one, x.shape)
    return result if y > 0 else program.elementwise("div", one, result)


def _sign(program: Program, x: Node) -> Node:
    if x.dtype in UNSIGNED:
        return program.elementwise("min", x, 1)
    minus, one = (program.constant(number, x.dtype) for number in (-1, 1))
    positive, negative = (program.elementwise(name, x, 0) for name in ("gt", "lt"))
    # 0 and NaN are returned as they are.
    return program.select(positive, program.select(negative, x, minus), one)


def _logistic(program: Program, x: Node) -> Node:
    decay = program.elementwise("exp", program.elementwise("neg", x))
    return program.elementwise("div", 1, program.elementwise("add", 1, decay))


def _one_minus_square(program: Program, x: Node) -> Node:
    return program.elementwise("mul", program.elementwise("sub", 1, x), program.elementwise("add", 1, x))


def _clamp(program: Program, low: Node, x: Node, high: Node) -> Node:
    return program.elementwise("min", program.elementwise("max", x, low), high)


def _select_n(program: Program, which: Node, *cases: Node) -> Node:
    if which.dtype == "bool":
        return program.select(which, *cases)
    result = cases[-1]
    for number, case in reversed(list(enumerate(cases[:-1]))):
        result = program.select(program.elementwise("eq", which, number), result, case)
    return result


def _bits(program: Program, x: Node, *, results: Any, kind: str) -> Node:
    """Applies `bitcast_convert_type` between types of one size."""
    word = "unsigned_long" if np.dtype(program.real).itemsize == 8 else "unsigned"
    if results[0].shape != x.shape or (x.dtype == "real" and NUMPY_TYPES[word]().itemsize != results[0].dtype.itemsize):
        raise InputError("the primitive 'bitcast_convert_type' has C for types of one size")
    if x.dtype == "real" != kind:
        return convert(program, program.elementwise(f"{word}_word_of", x), kind)
    return program.elementwise("number_of", convert(program, x, word)) if kind == "real" else convert(program, x, kind)


def _empty(program: Program, *, kind: str, shape: tuple[int, ...] = ()) -> Node:
    return program.constant(np.zeros(shape), kind)


def _iota(program: Program, *, shape, dimension: int, kind: str) -> Node:
    return program.constant(np.indices(shape)[dimension], kind)


def _reduce_precision(program: Program, x: Node, *, exponent_bits: int, mantissa_bits: int) -> Node:
    own = np.finfo(program.real)
    if exponent_bits >= own.nexp and mantissa_bits >= own.nmant:
        return x
    return program.elementwise("rounded", x, min(exponent_bits, own.nexp), min(mantissa_bits, own.nmant))


def _dot_general(program: Program, a: Node, b: Node, *, dimension_numbers, precision: Any, kind: str) -> Node:
    if isinstance(precision, lax.DotAlgorithm | lax.DotAlgorithmPreset):  # it may round operands and sums
        raise InputError(f"the primitive 'dot_general' has no C with precision={precision}")
    a, b = (convert(program, node, kind) for node in (a, b))
    (a_sum, b_sum), (a_batch, b_batch) = dimension_numbers
    a_free = [axis for axis in range(len(a.shape)) if axis not in (*a_sum, *a_batch)]
    b_free = [axis for axis in range(len(b.shape)) if axis not in (*b_sum, *b_batch)]

    def ordered(node: Node, *groups) -> Node:
        index = np.arange(node.size).reshape(node.shape).transpose([axis for group in groups for axis in group])
        return program.gather([node], index.reshape([prod(node.shape[axis] for axis in group) for group in groups]))

    product = program.dot_general(ordered(a, a_batch, a_free, a_sum), ordered(b, b_batch, b_sum, b_free))
    shape = [a.shape[axis] for axis in (*a_batch, *a_free)] + [b.shape[axis] for axis in b_free]
    return program.reshape(product, shape)


def _reduction(name: str) -> Rule:
    def rule(program: Program, node: Node, *, axes) -> Node:
        op, axes = on_kind(name, node.dtype), tuple(map(int, axes))
        shape = [size for axis, size in enumerate(node.shape) if axis not in axes]
        if node.size == 0:
            return program.broadcast(program.constant(neutral(op, node.dtype), node.dtype), shape)
        rows = rows_of(program, node, axes)
        columns = np.arange(rows.size).reshape(rows.shape).T
        if len(columns) > 2 and rows.size - program.finite * zeros(rows).sum() > UNROLL_LIMIT:
            return program.reshape(program.make(f"reduce_{op}", rows.shape[:1], node.dtype, [rows]), shape)
        terms = [program.gather([rows], positions) for positions in columns]
        return program.reshape(functools.reduce(functools.partial(program.elementwise, op), terms), shape)

    return rule


def _arg(name: str) -> Rule:
    def rule(program: Program, node: Node, *, axes, kind: str) -> Node:
        (axis,) = map(int, axes)
        rows = rows_of(program, node, (axis,))
        made = program.make(name, rows.shape[:1], kind, [rows])
        return program.reshape(made, node.shape[:axis] + node.shape[axis + 1 :])

    return rule


def _cumulative(op: str) -> Rule:
    """Returns the rule of a cumulative operation, unrolled along the axis."""

    def rule(program: Program, node: Node, *, axis: int, reverse: bool) -> Node:
        index = np.moveaxis(np.arange(node.size).reshape(node.shape), axis, 0)
        index = index[::-1] if reverse else index
        pieces: list[Node] = []
        for positions in index:
            piece = program.gather([node], positions)
            pieces.append(program.elementwise(op, pieces[-1], piece) if pieces else piece)
        if reverse:
            pieces.reverse()
        joined = np.arange(node.size).reshape(index.shape)
        return program.gather(pieces, np.moveaxis(joined, 0, axis)) if pieces else node

    return rule


_OF_REDUCTIONS = {"sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or", "xor": "xor"}
RULES: dict[str, Rule] = {
    **{name: _elementwise(name) for name in _AS_NAMED},
    "add_any": _elementwise("add"),
    **dict.fromkeys(("stop_gradient", "copy", "copy_p", "device_put", "optimization_barrier"), lambda _, *nodes: nodes),
    "square": lambda program, x: program.elementwise("mul", x, x),
    **{name: _comparison(name) for name in ("eq", "ne", "lt", "le", "gt", "ge")},
    **{f"{name}_to": _total_order(name) for name in ("lt", "le")},
    "reduce_precision": _reduce_precision,
    "sign": _sign,
    "rsqrt": lambda program, x: program.elementwise("div", 1, program.elementwise("sqrt", x)),
    "pow": _power,
    "integer_pow": _integer_power,
    "logistic": _logistic,
    "one_minus_square": _one_minus_square,
    "clamp": _clamp,
    "round": lambda program, x, *, rounding_method: program.elementwise("rint" if int(rounding_method) else "round", x),
    "select_n": _select_n,
    "convert_element_type": lambda program, x, *, kind: convert(program, x, kind),
    "iota": _iota,
    "empty": _empty,
    "empty2": _empty,
    "bitcast_convert_type": _bits,
    "broadcast_in_dim": _moved(_broadcast_in_dim),
    "reshape": _moved(lambda index, *, new_sizes: index.reshape(new_sizes)),
    "squeeze": _moved(lambda index, *, dimensions: np.squeeze(index, tuple(dimensions))),
    "expand_dims": _moved(lambda index, *, dimensions: np.expand_dims(index, tuple(dimensions))),
    "transpose": _moved(lambda index, *, permutation: index.transpose(permutation)),
    "rev": _moved(lambda index, *, dimensions: np.flip(index, dimensions)),
    "slice": _moved(_slice),
    "tile": _moved(lambda index, *, reps: np.tile(index, reps)),
    "pad": _moved(_pad),
    "concatenate": _moved(lambda *indices, dimension: np.concatenate(indices, axis=dimension)),
    "stack": _moved(lambda *indices, axis: np.stack(indices, axis)),
    "unstack": _moved(lambda index, *, axis: list(np.moveaxis(index, axis, 0))),
    "split": _moved(_split),
    "dot_general": _dot_general,
    **{f"reduce_{name}": _reduction(op) for name, op in _OF_REDUCTIONS.items()},
    **{name: _arg(name) for name in ("argmax", "argmin")},
    **{f"cum{name}": _cumulative(_OF_REDUCTIONS[name]) for name in ("sum", "prod", "max", "min")},
}
"""Rules by name of the primitive."""
