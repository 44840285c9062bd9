"""Rules that lower JAX's elementwise and shape primitives, products and reductions to nodes of a program.

A rule takes the program, the equation's parameters and its arguments, and returns one or several results. The
parameters include `kind`, the kind of the first result.
"""

import functools
from collections.abc import Callable, Mapping
from math import prod
from typing import Any

import numpy as np

from dln_jax.export.c.nodes import Node, zeros
from dln_jax.export.c.operations import on_kind
from dln_jax.export.c.program import Program
from dln_jax.export.c.simplify import UNROLL_LIMIT, neutral
from dln_jax.export.c.text import UNSIGNED

Rule = Callable[..., Any]
Parameters = Mapping[str, Any]
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
    return lambda program, _, *args: program.elementwise(name, *args)


def _moved(move: Callable[..., Any]) -> Rule:
    """Returns the rule of a primitive that only moves elements.

    `move` takes one array of element indices per argument, and the parameters; returns those of the results.
    """

    def rule(program: Program, parameters: Parameters, *nodes: Node) -> Any:
        starts = np.cumsum([0, *(node.size for node in nodes)])
        indices = [np.arange(node.size).reshape(node.shape) + k for node, k in zip(nodes, starts, strict=False)]
        moved = move(*indices, parameters)
        if isinstance(moved, list):
            return [program.gather(nodes, positions) for positions in moved]
        return program.gather(nodes, moved)

    return rule


def _broadcast_in_dim(index, parameters):
    shape, dimensions = parameters["shape"], parameters["broadcast_dimensions"]
    expanded = [1] * len(shape)
    for axis, size in zip(dimensions, index.shape, strict=True):
        expanded[axis] = size
    return np.broadcast_to(index.reshape(expanded), shape)


def _slice(index, parameters):
    strides = parameters["strides"] or [1] * index.ndim
    limits = zip(parameters["start_indices"], parameters["limit_indices"], strides, strict=True)
    return index[tuple(slice(int(start), int(limit), int(stride)) for start, limit, stride in limits)]


def _pad(index, padding, parameters):
    for axis, (low, high, interior) in enumerate(parameters["padding_config"]):
        step, extent = int(interior) + 1, index.shape[axis]
        place = np.arange(-int(low), max((extent - 1) * step + 1, 0) + int(high))
        chosen = np.where((place % step == 0) & (place >= 0), np.minimum(place // step, extent), extent)
        sides = [(0, int(other == axis)) for other in range(index.ndim)]
        index = np.pad(index, sides, constant_values=padding).take(chosen, axis)
    return index


def _split(index, parameters):
    return list(np.split(index, np.cumsum(parameters["sizes"])[:-1], axis=parameters["axis"]))


def _comparison(name: str) -> Rule:
    """Returns the rule of a comparison; booleans use logic, because compilers warn about comparing them."""

    def rule(program: Program, _, a: Node, b: Node) -> Node:
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

    def rule(program: Program, parameters, a: Node, b: Node) -> Node:
        return program.elementwise(f"{name}_to", a, b) if a.dtype == "real" else usual(program, parameters, a, b)

    return rule


def _power(program: Program, parameters: Parameters, x: Node, exponent: Node) -> Node:
    return program.elementwise("pow", *(convert(program, node, parameters["kind"]) for node in (x, exponent)))


def _integer_power(program: Program, parameters: Parameters, x: Node) -> Node:
    exponent, result = parameters["y"], None
    power, left = x, abs(exponent)
    while left:
        if left & 1:
            result = power if result is None else program.elementwise("mul", result, power)
        left >>= 1
        power = program.elementwise("mul", power, power) if left else power
    one = program.constant(1, x.dtype)
    if result is None:
        return program.broadcast(one, x.shape)
    return result if exponent > 0 else program.elementwise("div", one, result)


def _sign(program: Program, _, x: Node) -> Node:
    if x.dtype in UNSIGNED:
        return program.elementwise("min", x, 1)
    minus, one = (program.constant(number, x.dtype) for number in (-1, 1))
    positive, negative = (program.elementwise(name, x, 0) for name in ("gt", "lt"))
    # 0 and NaN are returned as they are.
    return program.select(positive, program.select(negative, x, minus), one)


def _logistic(program: Program, _, x: Node) -> Node:
    decay = program.elementwise("exp", program.elementwise("neg", x))
    return program.elementwise("div", 1, program.elementwise("add", 1, decay))


def _one_minus_square(program: Program, _, x: Node) -> Node:
    return program.elementwise("mul", program.elementwise("sub", 1, x), program.elementwise("add", 1, x))


def _clamp(program: Program, _, low: Node, x: Node, high: Node) -> Node:
    return program.elementwise("min", program.elementwise("max", x, low), high)


def _select_n(program: Program, _, which: Node, *cases: Node) -> Node:
    if which.dtype == "bool":
        return program.select(which, *cases)
    result = cases[-1]
    for number, case in reversed(list(enumerate(cases[:-1]))):
        result = program.select(program.elementwise("eq", which, number), result, case)
    return result


def _iota(program: Program, parameters: Parameters) -> Node:
    return program.constant(np.indices(parameters["shape"])[parameters["dimension"]], parameters["kind"])


def _reduce_precision(program: Program, parameters: Parameters, x: Node) -> Node:
    exponent, mantissa = parameters["exponent_bits"], parameters["mantissa_bits"]
    own = np.finfo(program.real)
    if exponent >= own.nexp and mantissa >= own.nmant:
        return x
    return program.elementwise("rounded", x, min(exponent, own.nexp), min(mantissa, own.nmant))


def _dot_general(program: Program, parameters: Parameters, a: Node, b: Node) -> Node:
    a, b = (convert(program, node, parameters["kind"]) for node in (a, b))
    (a_sum, b_sum), (a_batch, b_batch) = parameters["dimension_numbers"]
    a_free = [axis for axis in range(len(a.shape)) if axis not in (*a_sum, *a_batch)]
    b_free = [axis for axis in range(len(b.shape)) if axis not in (*b_sum, *b_batch)]

    def ordered(node: Node, *groups) -> Node:
        index = np.arange(node.size).reshape(node.shape).transpose([axis for group in groups for axis in group])
        return program.gather([node], index.reshape([prod(node.shape[axis] for axis in group) for group in groups]))

    product = program.dot_general(ordered(a, a_batch, a_free, a_sum), ordered(b, b_batch, b_sum, b_free))
    shape = [a.shape[axis] for axis in (*a_batch, *a_free)] + [b.shape[axis] for axis in b_free]
    return program.reshape(product, shape)


def _reduction(name: str) -> Rule:
    def rule(program: Program, parameters: Parameters, node: Node) -> Node:
        op, axes = on_kind(name, node.dtype), tuple(map(int, parameters["axes"]))
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
    def rule(program: Program, parameters: Parameters, node: Node) -> Node:
        (axis,) = map(int, parameters["axes"])
        rows = rows_of(program, node, (axis,))
        made = program.make(name, rows.shape[:1], parameters["kind"], [rows])
        return program.reshape(made, node.shape[:axis] + node.shape[axis + 1 :])

    return rule


def _cumulative(op: str) -> Rule:
    """Returns the rule of a cumulative operation, unrolled along the axis."""

    def rule(program: Program, parameters: Parameters, node: Node) -> Node:
        axis = parameters["axis"]
        index = np.moveaxis(np.arange(node.size).reshape(node.shape), axis, 0)
        index = index[::-1] if parameters["reverse"] else index
        pieces: list[Node] = []
        for positions in index:
            piece = program.gather([node], positions)
            pieces.append(program.elementwise(op, pieces[-1], piece) if pieces else piece)
        if parameters["reverse"]:
            pieces.reverse()
        joined = np.arange(node.size).reshape(index.shape)
        return program.gather(pieces, np.moveaxis(joined, 0, axis)) if pieces else node

    return rule


_OF_REDUCTIONS = {"sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or", "xor": "xor"}
RULES: dict[str, Rule] = {
    **{name: _elementwise(name) for name in _AS_NAMED},
    "add_any": _elementwise("add"),
    **dict.fromkeys(("stop_gradient", "copy", "copy_p", "optimization_barrier"), lambda _, __, *nodes: nodes),
    "square": lambda program, _, x: program.elementwise("mul", x, x),
    **{name: _comparison(name) for name in ("eq", "ne", "lt", "le", "gt", "ge")},
    **{f"{name}_to": _total_order(name) for name in ("lt", "le")},
    "reduce_precision": _reduce_precision,
    "sign": _sign,
    "rsqrt": lambda program, _, x: program.elementwise("div", 1, program.elementwise("sqrt", x)),
    "pow": _power,
    "integer_pow": _integer_power,
    "logistic": _logistic,
    "one_minus_square": _one_minus_square,
    "clamp": _clamp,
    "round": lambda program, p, x: program.elementwise("rint" if int(p["rounding_method"]) else "round", x),
    "select_n": _select_n,
    "convert_element_type": lambda program, parameters, x: convert(program, x, parameters["kind"]),
    "iota": _iota,
    "broadcast_in_dim": _moved(_broadcast_in_dim),
    "reshape": _moved(lambda index, parameters: index.reshape(parameters["new_sizes"])),
    "squeeze": _moved(lambda index, parameters: np.squeeze(index, tuple(parameters["dimensions"]))),
    "expand_dims": _moved(lambda index, parameters: np.expand_dims(index, tuple(parameters["dimensions"]))),
    "transpose": _moved(lambda index, parameters: index.transpose(parameters["permutation"])),
    "rev": _moved(lambda index, parameters: np.flip(index, parameters["dimensions"])),
    "slice": _moved(_slice),
    "tile": _moved(lambda index, parameters: np.tile(index, parameters["reps"])),
    "pad": _moved(_pad),
    "concatenate": _moved(lambda *indices: np.concatenate(indices[:-1], axis=indices[-1]["dimension"])),
    "stack": _moved(lambda *indices: np.stack(indices[:-1], indices[-1]["axis"])),
    "unstack": _moved(lambda index, parameters: list(np.moveaxis(index, parameters["axis"], 0))),
    "split": _moved(_split),
    "dot_general": _dot_general,
    **{f"reduce_{name}": _reduction(op) for name, op in _OF_REDUCTIONS.items()},
    **{name: _arg(name) for name in ("argmax", "argmin")},
    **{f"cum{name}": _cumulative(_OF_REDUCTIONS[name]) for name in ("sum", "prod", "max", "min")},
}
"""Rules by name of the primitive."""
