"""Elementwise operations: their C code, their NumPy function for constants, and their cost.

Integer arithmetic in C gives XLA's results: sums wrap around, divisions never trap, conversions saturate. C leaves
signed overflow, division by zero, the lowest number divided by -1, conversion of a real number that does not fit, and
shifts by at least the number of bits undefined. XLA defines them all (x / 0 is -1, or the largest unsigned number; x %
0 is x; NaN becomes 0; all bits are shifted out), and so does this C.
"""

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
from jax import lax

from dln_jax.export.c.elementary import OPERATIONS as COSTS
from dln_jax.export.c.elementary import VECTORISED as _VECTORISED
from dln_jax.export.c.text import C_TYPES, NUMPY_TYPES, SIGNED, UNSIGNED, limit, number


class Operation(NamedTuple):
    """An elementwise operation."""

    c: str
    """C expression in the arguments {0}, {1}, ...; {f} is the suffix of functions of <math.h>."""
    fold: Callable[..., Any] | None
    """The same for NumPy arrays. None leaves constants to C, which defines the values at poles."""
    cost: int = 1
    """Floating-point operations; comparisons and selections cost 0."""
    dtype: str | None = None
    """Kind of the result; None for the kind of the arguments."""
    function: str | None = None
    """Called function of <math.h>, if any."""
    integer: str = ""
    """C expression for integers and booleans of type {c}, with unsigned type {u}, if it differs."""

    def on(self, kind: str) -> str:
        """Returns the C expression for arguments of a kind; an `index` cannot overflow, so nothing wraps."""
        as_real = kind == "real" or (kind == "index" and "{u}" in self.integer)
        return self.c if as_real else self.integer or self.c

    def repeats_arguments(self, kind: str) -> bool:
        """Returns whether the C text contains an argument twice; the argument must then be a variable."""
        return any(self.on(kind).count(f"{{{k}}}") > 1 for k in range(3))


def _by_xla(name: str, real: Callable[..., Any] | None = None) -> Callable[..., Any]:
    """Returns a function that folds integers as XLA does where NumPy differs, and real numbers by NumPy."""

    def fold(*args: Any) -> Any:
        if real is not None and args[0].dtype.kind == "f":
            return real(*args)
        return np.asarray(getattr(lax, name)(*np.broadcast_arrays(*args)))

    return fold


def _conversion(kind: str, c: str) -> Operation:
    """Returns the conversion to an integer kind; real numbers are rounded towards zero and saturate."""
    to = NUMPY_TYPES[kind]

    def fold(x: Any) -> Any:
        return np.asarray(lax.convert_element_type(x, to)) if x.dtype.kind == "f" else x.astype(to)

    return Operation(f"elementary_{kind}_of({{0}})", fold, 0, kind, integer=f"(({c}){{0}})")


def _bits(kind: str) -> Operation:
    return Operation(f"(({C_TYPES[kind]})elementary_word_of({{0}}))", lambda x: x.view(NUMPY_TYPES[kind]), 0, kind)


def _function(name: str, fold: Callable[..., Any] | None, *, arguments: int = 1) -> Operation:
    call = f"{name}{{f}}({', '.join(f'{{{k}}}' for k in range(arguments))})"
    return Operation(call, fold, COSTS.get(name, 1), function=name)


def _comparison(symbol: str, fold: Callable[..., Any]) -> Operation:
    # The plus avoids compiler warnings about comparing booleans, bits, and numbers with themselves.
    return Operation(f"({{0}} {symbol} {{1}})", fold, 0, "bool", integer=f"(+{{0}} {symbol} +{{1}})")


_AS_IN_NUMPY = (
    "sqrt", "cbrt", "exp", "exp2", "expm1", "log", "log1p", "log2", "sin", "cos", "tan", "asin", "acos", "atan", "sinh",
    "cosh", "tanh", "asinh", "acosh", "atanh", "floor", "ceil", "rint", "trunc",
)  # fmt: skip
"""Functions of <math.h> with the same name in NumPy."""
OPERATIONS = {
    "add": Operation("({0} + {1})", np.add, integer="(({c})(({u}){0} + ({u}){1}))"),
    "sub": Operation("({0} - {1})", np.subtract, integer="(({c})(({u}){0} - ({u}){1}))"),
    "mul": Operation("({0} * {1})", np.multiply, integer="(({c})(({u}){0} * ({u}){1}))"),
    "multiply_add": Operation(
        "MULTIPLY_ADD({0}, {1}, {2})", lambda a, b, c: a * b + c, 2, integer="(({c})(({u}){2} + ({u}){0} * ({u}){1}))"
    ),
    "div": Operation("({0} / {1})", _by_xla("div", np.divide), integer="elementary_quotient_{kind}({0}, {1})"),
    "rem": _function("fmod", _by_xla("rem", np.fmod), arguments=2)._replace(
        integer="elementary_remainder_{kind}({0}, {1})"
    ),
    "neg": Operation("(-{0})", np.negative, 0, integer="(({c})(0 - ({u}){0}))"),
    "abs": Operation("fabs{f}({0})", np.abs, 0, integer="({0} < 0 ? ({c})(0 - ({u}){0}) : {0})"),
    "max": Operation("(({0} > {1} || {0} != {0}) ? {0} : {1})", np.maximum, 0, integer="(+{0} > +{1} ? {0} : {1})"),
    "min": Operation("(({0} < {1} || {0} != {0}) ? {0} : {1})", np.minimum, 0, integer="(+{0} < +{1} ? {0} : {1})"),
    **{name: _function(name, getattr(np, name), arguments=2) for name in ("pow", "atan2", "nextafter")},
    **{name: _function(name, getattr(np, name)) for name in _AS_IN_NUMPY},
    **{name: _function(name, np.vectorize(getattr(math, name), otypes=[float])) for name in ("erf", "erfc")},
    "lgamma": _function("lgamma", None),
    "round": _function("round", lambda x: np.copysign(np.floor(np.abs(x) + 0.5), x)),
    "is_finite": Operation("({0} - {0} == 0)", np.isfinite, 0, "bool"),
    # Arguments: a number, bits of the exponent, bits of the mantissa.
    "rounded": Operation("elementary_rounded({0}, {1}, {2})", None),
    # In the total order of IEEE 754: -0 before 0, NaN outside the infinities.
    "lt_to": Operation("(elementary_ordered({0}) < elementary_ordered({1}))", None, 0, "bool"),
    "le_to": Operation("(elementary_ordered({0}) <= elementary_ordered({1}))", None, 0, "bool"),
    "eq": _comparison("==", np.equal),
    "ne": _comparison("!=", np.not_equal),
    "lt": _comparison("<", np.less),
    "le": _comparison("<=", np.less_equal),
    "gt": _comparison(">", np.greater),
    "ge": _comparison(">=", np.greater_equal),
    "and": Operation("({0} & {1})", np.bitwise_and, 0),
    "or": Operation("({0} | {1})", np.bitwise_or, 0),
    "xor": Operation("({0} ^ {1})", np.bitwise_xor, 0),
    "not": Operation("(~{0})", np.invert, 0),
    "logical_not": Operation("(!{0})", np.logical_not, 0),
    **{
        f"shift_{name}": Operation(f"elementary_shift_{name}_{{kind}}({{0}}, {{1}})", _by_xla(f"shift_{name}"), 0)
        for name in ("left", "right_logical", "right_arithmetic")
    },
    "select": Operation("({0} ? {1} : {2})", lambda c, a, b: np.where(c, a, b), 0),
    **{f"to_{kind}": _conversion(kind, C_TYPES[kind]) for kind in NUMPY_TYPES},
    "to_real": Operation("((real){0})", lambda x: x, 0, "real"),
    "to_bool": Operation("({0} != 0)", lambda x: x != 0, 0, "bool", integer="(+{0} != 0)"),
    # Bits of a number as a word of its size, and back.
    **{f"{kind}_word_of": _bits(kind) for kind in UNSIGNED},
    "number_of": Operation("elementary_number_of({0})", lambda x: x.view(f"f{x.itemsize}"), 0, "real"),
}
"""Operations by name: the name of JAX's primitive if it exists."""


def total(operations: Mapping[str, int]) -> int:
    """Returns the number of floating-point operations in counts of operations by name."""
    return sum(OPERATIONS[name].cost * count for name, count in operations.items())


COMMUTATIVE = frozenset(("add", "mul", "eq", "ne", "and", "or", "xor"))
"""Operations that commute bit for bit, also in floating point."""
TRANSCENDENTAL = frozenset(name for name, operation in OPERATIONS.items() if operation.function and name != "sqrt")
"""Operations with a call of <math.h>, except sqrt."""
VECTORISED = frozenset(_VECTORISED)
"""Operations that vectorise in loops."""
_NEUTRAL = {"add": 0, "sub": 0, "mul": 1, "div": 1, "or": 0, "xor": 0}
_ON_BOOL = {"add": "or", "mul": "and", "max": "or", "min": "and", "ne": "xor", "not": "logical_not"}


def on_kind(op: str, kind: str) -> str:
    """Returns the name of an operation for a kind; some differ for booleans, and the total order is of real numbers."""
    op = op if kind == "real" else op.removesuffix("_to")
    return _ON_BOOL.get(op, op) if kind == "bool" else op


def neutral(op: str, kind: str) -> Any:
    """Returns the neutral element of an operation, or None without one."""
    if op in ("max", "min"):
        return limit(kind, upper=op == "min")
    return ~NUMPY_TYPES[kind](0) if op == "and" else _NEUTRAL.get(op)


def expression(op: str, kind: str, *args: str, suffix: str = "") -> str:
    """Returns the C text of an operation on numbers of a kind; `suffix` ends the names of <math.h> functions."""
    c = C_TYPES[kind]
    return OPERATIONS[op].on(kind).format(*args, f=suffix, kind=kind, c=c, u=f"u{c.removeprefix('u')}")


_GUARDED = {
    "quotient_{kind}({c} a, {c} b)": ("b == 0", "{at_zero}", "{quotient_of_lowest}a / b"),
    "remainder_{kind}({c} a, {c} b)": ("b == 0", "a", "{remainder_of_lowest}a % b"),
    "shift_left_{kind}({c} a, {c} b)": ("({u})b >= {bits}", "0", "({c})(({u})a << b)"),
    "shift_right_logical_{kind}({c} a, {c} b)": ("({u})b >= {bits}", "0", "({c})(({u})a >> b)"),
    "shift_right_arithmetic_{kind}({c} a, {c} b)": (
        "({u})b >= {bits}",
        "({s})a < 0 ? ({c})-1 : 0",
        "({s})a < 0 ? ({c})~(~({u})a >> b) : ({c})(({u})a >> b)",
    ),
    "{kind}_of(real x)": ("x != x", "0", "x <= {low} ? {lower} : x >= {high} ? {upper} : ({c})x"),
}
"""Prototype -> condition, result if it holds, and result otherwise, for the C functions of integers."""


def definitions(names: Collection[str], precision: str) -> str:
    """Returns the C functions `quotient_KIND`, `remainder_KIND`, `shift_NAME_KIND` and `KIND_of` (a real number)."""
    text = ""
    for kind in (*SIGNED, *UNSIGNED):
        c, signed, limits = C_TYPES[kind], kind in SIGNED, np.iinfo(NUMPY_TYPES[kind])
        name = c.removesuffix("_t").upper()
        facts = {
            "kind": kind, "c": c, "u": f"u{c.removeprefix('u')}", "s": c.removeprefix("u"), "bits": limits.bits,
            "low": number(float(limits.min), precision), "high": number(float(limits.max), precision),
            "lower": f"{name}_MIN" if signed else "0", "upper": f"{name}_MAX",
            "at_zero": "-1" if signed else f"{name}_MAX",
            "quotient_of_lowest": f"b == -1 ? ({c})(0 - (u{c})a) : " if signed else "",
            "remainder_of_lowest": "b == -1 ? 0 : " if signed else "",
        }  # fmt: skip
        for parts in _GUARDED.items():
            prototype, condition, then, otherwise = (part.format(**facts) for part in (parts[0], *parts[1]))
            if prototype.partition("(")[0] in names:
                text += f"\nstatic inline {c} elementary_{prototype}\n{{\n    if ({condition}) return {then};\n"
                text += f"    return {otherwise};\n}}\n"
    return text
