"""Elementwise operations: their C code, their NumPy function for constants, and their cost.

Integer arithmetic in C gives XLA's results: sums wrap around, divisions never trap, conversions saturate. C leaves
signed overflow, division by zero, the lowest number divided by -1, conversion of a real number that does not fit, and
shifts by at least the number of bits undefined. XLA defines them all (x / 0 is -1, or the largest unsigned number; x %
0 is x; NaN becomes 0; all bits are shifted out), and so does this C.
"""

import functools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from dln_jax.export.c.elementary import OPERATIONS as COSTS
from dln_jax.export.c.elementary import VECTORISED as _VECTORISED
from dln_jax.export.c.text import C_TYPES, NUMPY_TYPES, SIGNED, UNSIGNED, number


def _quotient(a, b):
    """Returns `a / b` for integer arrays, rounded towards zero."""
    safe = np.where(b == 0, np.ones_like(b), b)
    whole = a // safe
    if a.dtype.kind == "i":
        whole = whole + ((whole * safe != a) & ((a < 0) != (safe < 0)))
    return np.where(b == 0, a.dtype.type(-1) if a.dtype.kind == "i" else np.iinfo(a.dtype).max, whole)


def _remainder(a, b):
    """Returns `a % b` for integer arrays, with the sign of a."""
    safe = np.where((b == 0) | (b == -1), np.ones_like(b), b) if b.dtype.kind == "i" else np.where(b == 0, 1, b)
    return np.where(b == 0, a, np.fmod(a, safe))


def _converted(x, kind: str):
    """Converts an array to a kind; real numbers are rounded towards zero and saturate."""
    to = NUMPY_TYPES[kind]
    if x.dtype.kind != "f":
        return x.astype(to)
    low, high = np.iinfo(to).min, np.iinfo(to).max
    representable = (x > float(low)) & (x < float(high))
    whole = np.where(representable, x, 0).astype(to)
    return np.where(representable | (x != x), whole, np.where(x > 0, to(high), to(low)))


def _shifted_right(a, b, *, kind: str):
    """Returns `a >> b` for arrays, with zeros (kind "u") or copies of the sign bit (kind "i") shifted in.

    NumPy shifts like XLA: a negative amount, or one of at least the number of bits, shifts all bits out.
    """
    typed = np.dtype(f"{kind}{a.dtype.itemsize}")
    return np.right_shift(a.view(typed), b.view(typed)).view(a.dtype)


def _bits(kind: str) -> Callable[..., Any]:
    return lambda x: x.view(NUMPY_TYPES[kind])


class Operation(NamedTuple):
    """An elementwise operation."""

    c: str
    """C expression in the arguments {0}, {1}, ...; {f} is the suffix of functions of <math.h>."""
    fold: Callable[..., Any] | None
    """The same for NumPy arrays; None leaves constants to C, which defines the values at poles."""
    cost: int = 1
    """Floating-point operations; comparisons and selections cost 0."""
    dtype: str | None = None
    """Kind of the result; None for that of the arguments."""
    function: str | None = None
    """Function of <math.h> that it calls, if any."""

    @property
    def repeats_arguments(self) -> bool:
        """Whether the C contains an argument twice, which must then be a variable."""
        return any(self.c.count(f"{{{k}}}") > 1 for k in range(3))


def _function(name: str, fold: Callable[..., Any] | None, *, arguments: int = 1) -> Operation:
    call = f"{name}{{f}}({', '.join(f'{{{k}}}' for k in range(arguments))})"
    return Operation(call, fold, COSTS.get(name, 1), function=name)


def _comparison(symbol: str, fold: Callable[..., Any]) -> Operation:
    return Operation(f"({{0}} {symbol} {{1}})", fold, 0, "bool")


_AS_IN_NUMPY = (
    "sqrt", "cbrt", "exp", "exp2", "expm1", "log", "log1p", "log2", "sin", "cos", "tan", "asin", "acos", "atan", "sinh",
    "cosh", "tanh", "asinh", "acosh", "atanh", "floor", "ceil", "rint", "trunc",
)  # fmt: skip
"""Functions of <math.h> that have the same name in NumPy."""
OPERATIONS = {
    "add": Operation("({0} + {1})", np.add),
    "sub": Operation("({0} - {1})", np.subtract),
    "mul": Operation("({0} * {1})", np.multiply),
    "multiply_add": Operation("MULTIPLY_ADD({0}, {1}, {2})", lambda a, b, c: a * b + c, 2),
    "div": Operation("({0} / {1})", np.divide),
    "integer_div": Operation("({0} / {1})", _quotient),
    "neg": Operation("(-{0})", np.negative, 0),
    "abs": Operation("fabs{f}({0})", np.abs, 0),
    "integer_abs": Operation("({0} < 0 ? -{0} : {0})", np.abs, 0),
    "max": Operation("(({0} > {1} || {0} != {0}) ? {0} : {1})", np.maximum, 0),
    "min": Operation("(({0} < {1} || {0} != {0}) ? {0} : {1})", np.minimum, 0),
    "integer_rem": Operation("({0} % {1})", _remainder, 0),
    "rem": _function("fmod", np.fmod, arguments=2),
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
    "not": Operation("(!{0})", np.logical_not, 0),
    "integer_not": Operation("(~{0})", np.invert, 0),
    **{
        f"shift_{name}": Operation(f"elementary_shift_{name}({{0}}, {{1}})", fold, 0)
        for name, fold in {
            "left": np.left_shift,
            "right_logical": functools.partial(_shifted_right, kind="u"),
            "right_arithmetic": functools.partial(_shifted_right, kind="i"),
        }.items()
    },
    "select": Operation("({0} ? {1} : {2})", lambda c, a, b: np.where(c, a, b), 0),
    **{
        f"to_{kind}": Operation(f"(({C_TYPES[kind]}){{0}})", functools.partial(_converted, kind=kind), 0, kind)
        for kind in NUMPY_TYPES
    },
    # Bits of a number as a word of its size, and back.
    **{
        f"{kind}_word_of": Operation(f"(({C_TYPES[kind]})elementary_word_of({{0}}))", _bits(kind), 0, kind)
        for kind in UNSIGNED
    },
    "number_of": Operation("elementary_number_of({0})", lambda x: x.view(f"f{x.itemsize}"), 0, "real"),
    "to_real": Operation("((real){0})", lambda x: x, 0, "real"),
    "to_bool": Operation("({0} != 0)", lambda x: x != 0, 0, "bool"),
}
"""Operations by name."""


def total(operations: Mapping[str, int]) -> int:
    """Returns the number of floating-point operations in counts of operations by name."""
    return sum(OPERATIONS[name].cost * count for name, count in operations.items())


COMMUTATIVE = frozenset(("add", "mul", "eq", "ne", "and", "or", "xor"))
"""Operations that commute bit for bit, also in floating point."""
TRANSCENDENTAL = frozenset(name for name, operation in OPERATIONS.items() if operation.function and name != "sqrt")
"""Operations that call a function of <math.h>, except sqrt."""
VECTORISED = frozenset(_VECTORISED)
"""Operations whose C vectorises in loops."""
BY_BITS = {
    "rounded": "rounded", "lt_to": "ordered", "le_to": "ordered", "number_of": "choice",
    **{f"{kind}_word_of": "choice" for kind in UNSIGNED},
}  # fmt: skip
"""The part of the elementary functions that an operation on the bits of numbers needs."""
_ON_BOOL = {"add": "or", "mul": "and", "max": "or", "min": "and", "ne": "xor"}


def on_kind(op: str, kind: str) -> str:
    """Returns the name of an operation for a kind; some differ for integers and booleans."""
    if kind == "bool":
        return _ON_BOOL.get(op, op)
    return f"integer_{op}" if kind != "real" and f"integer_{op}" in OPERATIONS else op


_WRAPPED = {
    "add": "({c})(({u}){{0}} + ({u}){{1}})",
    "sub": "({c})(({u}){{0}} - ({u}){{1}})",
    "mul": "({c})(({u}){{0}} * ({u}){{1}})",
    "neg": "({c})(0 - ({u}){{0}})",
    "integer_abs": "({{0}} < 0 ? ({c})(0 - ({u}){{0}}) : {{0}})",
}
# With a plus, because compilers warn about comparing bits, some of them constant, with a number that they never equal.
_ON_INTEGERS = {
    "max": "({0} > {1} ? {0} : {1})", "min": "({0} < {1} ? {0} : {1})", "and": "(+({0} & {1}))", "or": "(+({0} | {1}))",
}  # fmt: skip
_ON_UNSIGNED = {"neg": "(0 - {0})", "integer_abs": "{0}"}


def _pattern(op: str, kind: str) -> str:
    """Returns the C of an operation on arguments {0}, {1}, ... of a kind."""
    if kind in SIGNED and op in _WRAPPED:
        return f"({_WRAPPED[op].format(c=C_TYPES[kind], u='u' + C_TYPES[kind])})"
    special = {} if kind == "real" else _ON_INTEGERS | (_ON_UNSIGNED if kind in UNSIGNED else {})
    return special.get(op, OPERATIONS[op].c)


def expression(op: str, dtype: str, *args: str, suffix: str = "") -> str:
    """Returns the C of an operation on numbers of a kind; `suffix` ends the names of functions of <math.h>."""
    alike = len(args) == 2 and args[0] == args[1]  # compilers warn about comparing a number with itself
    if alike and (op in ("lt", "gt") or (dtype != "real" and op in ("eq", "ne", "le", "ge"))):
        return str(int(op in ("eq", "le", "ge")))
    if alike and op in ("max", "min"):
        return args[0]
    if dtype in UNSIGNED and (known := _beside_zero(op, args)):
        return known
    return _pattern(op, dtype).format(*args, f=suffix)


def _beside_zero(op: str, args: Sequence[str]) -> str | None:
    """Returns C that compares an unsigned number with a literal 0 without compiler warnings, or None."""
    zeros = ("0U", "0ULL")
    if op in ("max", "min") and not {*zeros}.isdisjoint(args):
        other = args[0] if args[1] in zeros else args[1]
        return other if op == "max" else f"({other} & 0U)"
    if op in ("lt", "ge", "gt", "le"):
        other, zero = args if op in ("lt", "ge") else args[::-1]
        return f"(({other} == 0U) {'|' if op in ('ge', 'le') else '&'} ({other} > 0U))" if zero in zeros else None
    return None


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
"""Prototype, condition, result if the condition holds and result otherwise, of the C functions on integers."""


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
