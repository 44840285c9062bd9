"""Rules that turn JAX's elementwise and shape primitives into nodes of a program.

A rule takes the program, the equation's parameters and its arguments, and returns the result or a list of results.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from dln_jax.export.c.kinds import UNSIGNED
from dln_jax.export.c.nodes import Node
from dln_jax.export.c.program import Program

Rule = Callable[..., Any]

_RENAMED = {
    "add_any": "add",
    "stop_gradient": None,
    "copy": None,
    "copy_p": None,
    "optimization_barrier": None,
}
_AS_NAMED = (
    "add", "sub", "mul", "atan2", "sqrt", "cbrt", "exp", "exp2", "expm1", "log", "log1p",
    "log2", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erf",
    "erfc", "lgamma", "floor", "ceil", "is_finite", "and", "or", "xor", "nextafter", "shift_left",
    "shift_right_logical", "shift_right_arithmetic",
)  # fmt: skip


def _elementwise(name: str) -> Rule:
    return lambda program, _, *args: program.elementwise(name, *args)


def _moved(move: Callable[..., np.ndarray]) -> Rule:
    """Returns the rule of a primitive that only moves elements; `move` does so to an array of their indices."""

    def rule(program: Program, parameters: dict[str, Any], node: Node, *_: Node) -> Node:
        return program.gather([node], move(np.arange(node.size).reshape(node.shape), parameters))

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


def _power(program: Program, _, x: Node, exponent: Node, *, dtype: str) -> Node:
    return program.elementwise("pow", convert(program, x, dtype), convert(program, exponent, dtype))


def _comparison(name: str) -> Rule:
    """Returns the rule of a comparison; booleans are compared by logic, since compilers warn of comparing them."""

    def rule(program: Program, _, a: Node, b: Node) -> Node:
        if a.dtype != "bool":
            return program.elementwise(name, a, b)
        if name in ("eq", "ne"):
            different = program.elementwise("xor", a, b)
            return different if name == "ne" else program.elementwise("not", different)
        # a < b is (not a) and b; a <= b is (not a) or b
        low, high = (a, b) if name in ("lt", "le") else (b, a)
        return program.elementwise("and" if name in ("lt", "gt") else "or", program.elementwise("not", low), high)

    return rule


def _total_order(name: str) -> Rule:
    """Returns the rule of a comparison in the total order of IEEE 754, which for other kinds is the usual one."""
    usual = _comparison(name)

    def rule(program: Program, parameters, a: Node, b: Node) -> Node:
        return program.elementwise(f"{name}_to", a, b) if a.dtype == "real" else usual(program, parameters, a, b)

    return rule


def _extreme(name: str) -> Rule:
    on_truths = "or" if name == "max" else "and"
    return lambda program, _, *args: program.elementwise(on_truths if args[0].dtype == "bool" else name, *args)


def _integer_power(program: Program, parameters, x: Node) -> Node:
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
    zero, one = (program.constant(number, x.dtype) for number in (0, 1))
    if x.dtype in UNSIGNED:
        return program.elementwise("min", x, one)
    minus = program.constant(-1, x.dtype)
    positive, negative = (program.elementwise(name, x, zero) for name in ("gt", "lt"))
    # 0 and NaN are their own sign.
    return program.select(positive, program.select(negative, x, minus), one)


def _logistic(program: Program, _, x: Node) -> Node:
    one = program.constant(1.0, "real")
    decay = program.elementwise("exp", program.elementwise("neg", x))
    return program.elementwise("div", one, program.elementwise("add", one, decay))


def _one_minus_square(program: Program, _, x: Node) -> Node:
    one = program.constant(1.0, "real")
    return program.elementwise("mul", program.elementwise("sub", one, x), program.elementwise("add", one, x))


def _clamp(program: Program, _, low: Node, x: Node, high: Node) -> Node:
    return program.elementwise("min", program.elementwise("max", x, low), high)


def _select_n(program: Program, _, which: Node, *cases: Node) -> Node:
    if which.dtype == "bool":
        return program.select(which, *cases)
    result = cases[-1]
    for number, case in reversed(list(enumerate(cases[:-1]))):
        result = program.select(program.elementwise("eq", which, program.constant(number, which.dtype)), result, case)
    return result


def _by_kind(real: str, integer: str) -> Rule:
    def rule(program: Program, _, *args: Node, dtype: str) -> Node:
        return program.elementwise(real if dtype == "real" else integer, *args)

    return rule


def _not(program: Program, _, x: Node) -> Node:
    return program.elementwise("not" if x.dtype == "bool" else "integer_not", x)


def _round(program: Program, parameters, x: Node) -> Node:
    return program.elementwise("rint" if int(parameters["rounding_method"]) else "round", x)


def convert(program: Program, node: Node, dtype: str) -> Node:
    """Returns the node converted to a kind."""
    if node.dtype == dtype:
        return node
    return program.elementwise(f"to_{dtype}", node)


def _pad(program: Program, parameters, x: Node, padding: Node) -> Node:
    index = np.arange(x.size).reshape(x.shape)
    for axis, (low, high, interior) in enumerate(parameters["padding_config"]):
        low, high, interior, extent = int(low), int(high), int(interior), index.shape[axis]
        inner = extent + max(extent - 1, 0) * interior
        shape = list(index.shape)
        shape[axis] = inner
        spread = np.full(shape, x.size)
        np.moveaxis(spread, axis, 0)[:: interior + 1] = np.moveaxis(index, axis, 0)
        wide = [(max(low, 0), max(high, 0)) if other == axis else (0, 0) for other in range(index.ndim)]
        index = np.pad(spread, wide, constant_values=x.size)
        cut = slice(max(-low, 0), index.shape[axis] - max(-high, 0))
        index = index[(slice(None),) * axis + (cut,)]
    return program.gather([x, padding], index)


def _concatenate(program: Program, parameters, *nodes: Node) -> Node:
    starts = np.cumsum([0, *(node.size for node in nodes)])
    pieces = [np.arange(node.size).reshape(node.shape) + start for node, start in zip(nodes, starts, strict=False)]
    return program.gather(nodes, np.concatenate(pieces, axis=parameters["dimension"]))


def _stack(program: Program, parameters, *nodes: Node) -> Node:
    pieces = np.arange(sum(node.size for node in nodes)).reshape(len(nodes), *nodes[0].shape)
    return program.gather(nodes, np.moveaxis(pieces, 0, parameters["axis"]))


def _unstack(program: Program, parameters, node: Node) -> list[Node]:
    index = np.moveaxis(np.arange(node.size).reshape(node.shape), parameters["axis"], 0)
    return [program.gather([node], piece) for piece in index]


def _split(program: Program, parameters, node: Node) -> list[Node]:
    index = np.arange(node.size).reshape(node.shape)
    pieces = np.split(index, np.cumsum(parameters["sizes"])[:-1], axis=parameters["axis"])
    return [program.gather([node], piece) for piece in pieces]


def _iota(program: Program, parameters, dtype: str) -> Node:
    shape, dimension = parameters["shape"], parameters["dimension"]
    expanded = [-1 if axis == dimension else 1 for axis in range(len(shape))]
    numbers = np.broadcast_to(np.arange(shape[dimension]).reshape(expanded), shape)
    return program.constant(numbers, dtype)


def _reciprocal_root(program: Program, _, x: Node) -> Node:
    return program.elementwise("div", program.constant(1.0, "real"), program.elementwise("sqrt", x))


def _reduce_precision(program: Program, parameters, x: Node) -> Node:
    exponent, mantissa = parameters["exponent_bits"], parameters["mantissa_bits"]
    own = np.finfo(program.real)
    if exponent >= own.nexp and mantissa >= own.nmant:
        return x
    bits = [program.constant(min(*pair), "real") for pair in ((exponent, own.nexp), (mantissa, own.nmant))]
    return program.elementwise("rounded", x, *bits)


def _identity(_, __, *nodes: Node) -> Any:
    return list(nodes)


RULES: dict[str, Rule] = {
    **{name: _elementwise(name) for name in _AS_NAMED},
    **{name: _identity if op is None else _elementwise(op) for name, op in _RENAMED.items()},
    "square": lambda program, _, x: program.elementwise("mul", x, x),
    "neg": lambda program, _, x: program.elementwise("neg", x),
    **{name: _comparison(name) for name in ("eq", "ne", "lt", "le", "gt", "ge")},
    **{f"{name}_to": _total_order(name) for name in ("lt", "le")},
    **{name: _extreme(name) for name in ("max", "min")},
    "reduce_precision": _reduce_precision,
    "not": _not,
    "sign": _sign,
    "rsqrt": _reciprocal_root,
    "integer_pow": _integer_power,
    "logistic": _logistic,
    "one_minus_square": _one_minus_square,
    "clamp": _clamp,
    "round": _round,
    "select_n": _select_n,
    "broadcast_in_dim": _moved(_broadcast_in_dim),
    "reshape": _moved(lambda index, parameters: index.reshape(parameters["new_sizes"])),
    "squeeze": _moved(lambda index, parameters: np.squeeze(index, tuple(parameters["dimensions"]))),
    "expand_dims": _moved(lambda index, parameters: np.expand_dims(index, tuple(parameters["dimensions"]))),
    "transpose": _moved(lambda index, parameters: index.transpose(parameters["permutation"])),
    "rev": _moved(lambda index, parameters: np.flip(index, parameters["dimensions"])),
    "slice": _moved(_slice),
    "tile": _moved(lambda index, parameters: np.tile(index, parameters["reps"])),
    "pad": _pad,
    "concatenate": _concatenate,
    "stack": _stack,
    "unstack": _unstack,
    "split": _split,
}
"""Rules by the name of the primitive."""
TYPED_RULES: dict[str, Rule] = {
    "abs": _by_kind("abs", "integer_abs"),
    "div": _by_kind("div", "integer_div"),
    "rem": _by_kind("rem", "integer_rem"),
    "pow": _power,
    "convert_element_type": lambda program, _, x, *, dtype: convert(program, x, dtype),
    "iota": lambda program, parameters, *, dtype: _iota(program, parameters, dtype),
}
"""Rules that also take the kind of the result."""
