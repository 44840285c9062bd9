"""Elementwise operations: their C, their NumPy function for constants, and their cost."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from dln_jax.export.c import integers
from dln_jax.export.c.elementary import OPERATIONS as COSTS
from dln_jax.export.c.elementary import VECTORISED as _VECTORISED
from dln_jax.export.c.kinds import C_TYPES, NUMPY_TYPES, UNSIGNED


class Operation(NamedTuple):
    """An elementwise operation."""

    c: str
    """C expression in the arguments {0}, {1}, ...; {f} is the suffix of functions of <math.h>."""
    fold: Callable[..., Any] | None
    """The same for NumPy arrays; None leaves constants to C, which defines the values at poles."""
    cost: int = 1
    """Floating-point operations; comparisons and selections cost 0."""
    dtype: str | None = None
    """Kind of the result; None for the kind of the arguments."""
    function: str | None = None
    """Function of <math.h> that it calls, if any."""


def _function(name: str, fold: Callable[..., Any] | None, *, arguments: int = 1) -> Operation:
    call = f"{name}{{f}}({', '.join(f'{{{k}}}' for k in range(arguments))})"
    return Operation(call, fold, COSTS.get(name, 1), function=name)


def _comparison(symbol: str, fold: Callable[..., Any]) -> Operation:
    return Operation(f"({{0}} {symbol} {{1}})", fold, 0, "bool")


OPERATIONS = {
    "add": Operation("({0} + {1})", np.add),
    "sub": Operation("({0} - {1})", np.subtract),
    "mul": Operation("({0} * {1})", np.multiply),
    "div": Operation("({0} / {1})", np.divide),
    "integer_div": Operation("({0} / {1})", integers.quotient),
    "neg": Operation("(-{0})", np.negative, 0),
    "abs": Operation("fabs{f}({0})", np.abs, 0),
    "integer_abs": Operation("({0} < 0 ? -{0} : {0})", np.abs, 0),
    "max": Operation("(({0} > {1} || {0} != {0}) ? {0} : {1})", np.maximum, 0),
    "min": Operation("(({0} < {1} || {0} != {0}) ? {0} : {1})", np.minimum, 0),
    "integer_rem": Operation("({0} % {1})", integers.remainder, 0),
    "rem": _function("fmod", np.fmod, arguments=2),
    "sqrt": _function("sqrt", np.sqrt),
    "pow": _function("pow", np.power, arguments=2),
    "atan2": _function("atan2", np.arctan2, arguments=2),
    "nextafter": _function("nextafter", np.nextafter, arguments=2),
    **{
        name: _function(name, fold)
        for name, fold in {
            "cbrt": np.cbrt,
            "exp": np.exp,
            "exp2": np.exp2,
            "expm1": np.expm1,
            "log": np.log,
            "log1p": np.log1p,
            "log2": np.log2,
            "sin": np.sin,
            "cos": np.cos,
            "tan": np.tan,
            "asin": np.arcsin,
            "acos": np.arccos,
            "atan": np.arctan,
            "sinh": np.sinh,
            "cosh": np.cosh,
            "tanh": np.tanh,
            "asinh": np.arcsinh,
            "acosh": np.arccosh,
            "atanh": np.arctanh,
            "erf": np.vectorize(math.erf, otypes=[float]),
            "erfc": np.vectorize(math.erfc, otypes=[float]),
            "lgamma": None,
            "floor": np.floor,
            "ceil": np.ceil,
            "rint": np.rint,
            "trunc": np.trunc,
        }.items()
    },
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
        for name, fold in integers.SHIFTS.items()
    },
    "select": Operation("({0} ? {1} : {2})", lambda c, a, b: np.where(c, a, b), 0),
    **{
        f"to_{kind}": Operation(f"(({C_TYPES[kind]}){{0}})", functools.partial(integers.converted, kind=kind), 0, kind)
        for kind in NUMPY_TYPES
    },
    "to_real": Operation("((real){0})", lambda x: x, 0, "real"),
    "to_bool": Operation("({0} != 0)", lambda x: x != 0, 0, "bool"),
}
"""Operations by name."""


def expression(op: str, dtype: str, *args: str, suffix: str = "") -> str:
    """Returns the C of an operation on numbers of a kind; `suffix` ends the names of functions of <math.h>."""
    alike = len(args) == 2 and args[0] == args[1]  # compilers warn of comparing a number with itself
    if alike and (op in ("lt", "gt") or (dtype != "real" and op in ("eq", "ne", "le", "ge"))):
        return str(int(op in ("eq", "le", "ge")))
    if alike and op in ("max", "min"):
        return args[0]
    if dtype in UNSIGNED and (known := _beside_zero(op, args)):
        return known
    text = integers.pattern(op, dtype) if dtype != "real" else None
    return (text or OPERATIONS[op].c).format(*args, f=suffix)


def _beside_zero(op: str, args: Sequence[str]) -> str | None:
    """Returns C for an unsigned number against a literal 0, where compilers warn of the plain comparison, or None."""
    zeros = ("0U", "0ULL")
    if op in ("max", "min") and not {*zeros}.isdisjoint(args):
        other = args[0] if args[1] in zeros else args[1]
        return other if op == "max" else f"({other} & 0U)"
    if op in ("lt", "ge", "gt", "le"):
        other, zero = args if op in ("lt", "ge") else args[::-1]
        return f"(({other} == 0U) {'|' if op in ('ge', 'le') else '&'} ({other} > 0U))" if zero in zeros else None
    return None


COMMUTATIVE = frozenset(("add", "mul", "eq", "ne", "and", "or", "xor"))
"""Operations that commute bit for bit, also in floating point."""
TRANSCENDENTAL = frozenset(
    name for name, operation in OPERATIONS.items() if operation.function and name not in ("sqrt",)
)
"""Operations that call a function of <math.h>, but for sqrt."""
VECTORISED = frozenset(_VECTORISED)
"""Operations whose C vectorises in loops."""
