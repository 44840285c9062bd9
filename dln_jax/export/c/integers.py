"""Integer arithmetic in C with XLA's results: sums wrap around, divisions never trap, conversions saturate.

C leaves undefined: signed overflow, division by zero, the lowest number over -1, the conversion of a real number that
does not fit, and shifts by at least the number of bits. XLA defines them all (x / 0 is -1, or the largest unsigned
number; x % 0 is x; NaN becomes 0; all bits are shifted out), and so does this C.
"""

import functools
from collections.abc import Iterable

import numpy as np

from dln_jax.export.c.kinds import C_TYPES, NUMPY_TYPES, SIGNED, UNSIGNED
from dln_jax.export.c.text import number

_WRAPPED = {"add": "({c})(({u}){{0}} + ({u}){{1}})", "sub": "({c})(({u}){{0}} - ({u}){{1}})"}
_WRAPPED |= {"mul": "({c})(({u}){{0}} * ({u}){{1}})", "neg": "({c})(0 - ({u}){{0}})"}
_WRAPPED["integer_abs"] = "({{0}} < 0 ? ({c})(0 - ({u}){{0}}) : {{0}})"
_ON_ALL = {"max": "({0} > {1} ? {0} : {1})", "min": "({0} < {1} ? {0} : {1})"}
_ON_UNSIGNED = {"neg": "(0 - {0})", "integer_abs": "{0}"}
_QUOTIENT = {True: "b == -1 ? {lower} : a / b", False: "a / b"}
_REMAINDER = {True: "b == -1 ? 0 : a % b", False: "a % b"}


def pattern(op: str, kind: str) -> str | None:
    """Returns the C of an operation on integers {0}, {1}, or None if it equals the C for real numbers."""
    if op in _ON_ALL:
        return _ON_ALL[op]
    if kind in SIGNED and op in _WRAPPED:
        return f"({_WRAPPED[op].format(c=C_TYPES[kind], u='u' + C_TYPES[kind])})"
    return _ON_UNSIGNED.get(op) if kind in UNSIGNED else None


def quotient(a, b):
    """Returns `a / b` for arrays, rounded towards zero."""
    safe = np.where(b == 0, np.ones_like(b), b)
    whole = a // safe
    if a.dtype.kind == "i":
        whole = whole + ((whole * safe != a) & ((a < 0) != (safe < 0)))
    return np.where(b == 0, a.dtype.type(-1) if a.dtype.kind == "i" else np.iinfo(a.dtype).max, whole)


def remainder(a, b):
    """Returns `a % b` for arrays, with the sign of a."""
    safe = np.where((b == 0) | (b == -1), np.ones_like(b), b) if b.dtype.kind == "i" else np.where(b == 0, 1, b)
    return np.where(b == 0, a, np.fmod(a, safe))


def converted(x, kind: str):
    """Converts an array to a kind; real numbers are rounded towards zero and saturate."""
    to = NUMPY_TYPES[kind]
    if x.dtype.kind != "f":
        return x.astype(to)
    low, high = np.iinfo(to).min, np.iinfo(to).max
    inside = (x > float(low)) & (x < float(high))
    whole = np.where(inside, x, 0).astype(to)
    return np.where(inside | (x != x), whole, np.where(x > 0, to(high), to(low)))


def _shifted_right(a, b, *, kind: str):
    """Returns `a >> b` for arrays, with zeros (kind "u") or copies of the sign bit (kind "i") shifted in.

    NumPy shifts as XLA does: a negative amount, or one of at least the number of bits, shifts all bits out.
    """
    typed = np.dtype(f"{kind}{a.dtype.itemsize}")
    return np.right_shift(a.view(typed), b.view(typed)).view(a.dtype)


SHIFTS = {
    "left": np.left_shift,
    "right_logical": functools.partial(_shifted_right, kind="u"),
    "right_arithmetic": functools.partial(_shifted_right, kind="i"),
}
"""NumPy functions of the shifts, by name."""
_ALL_SHIFTED_OUT = {"left": "0", "right_logical": "0", "right_arithmetic": "({s})a < 0 ? ({c})-1 : 0"}
_SHIFTED = {
    "left": "({c})(({u})a << b)",
    "right_logical": "({c})(({u})a >> b)",
    "right_arithmetic": "({s})a < 0 ? ({c})~(~({u})a >> b) : ({c})(({u})a >> b)",
}


def definitions(names: Iterable[str], precision: str) -> str:
    """Returns the C functions `quotient_KIND`, `remainder_KIND`, `shift_NAME_KIND` and `KIND_of` (a real number)."""
    names = set(names)
    text = ""
    for kind in (*SIGNED, *UNSIGNED):
        c, signed = C_TYPES[kind], kind in SIGNED
        limits = c.removesuffix("_t").upper()
        facts = {"lower": f"({c})(0 - (u{c})a)"}
        if f"quotient_{kind}" in names:
            at_zero = "-1" if signed else f"{limits}_MAX"
            text += _function(f"{c} elementary_quotient_{kind}({c} a, {c} b)", "b == 0", at_zero,
                              _QUOTIENT[signed].format(**facts))  # fmt: skip
        if f"remainder_{kind}" in names:
            text += _function(f"{c} elementary_remainder_{kind}({c} a, {c} b)", "b == 0", "a", _REMAINDER[signed])
        types = {"c": c, "u": f"u{c.removeprefix('u')}", "s": c.removeprefix("u")}
        for shift in (name for name in SHIFTS if f"shift_{name}_{kind}" in names):
            text += _function(f"{c} elementary_shift_{shift}_{kind}({c} a, {c} b)",
                              f"({types['u']})b >= {8 * np.dtype(NUMPY_TYPES[kind]).itemsize}",
                              _ALL_SHIFTED_OUT[shift].format(**types), _SHIFTED[shift].format(**types))  # fmt: skip
        if f"{kind}_of" in names:
            low, high = (float(limit) for limit in (np.iinfo(NUMPY_TYPES[kind]).min, np.iinfo(NUMPY_TYPES[kind]).max))
            lower, upper = f"{limits}_MIN" if signed else "0", f"{limits}_MAX"
            inside = f"x >= {number(high, precision)} ? {upper} : ({c})x"
            bounded = f"x <= {number(low, precision)} ? {lower} : {inside}"
            text += _function(f"{c} elementary_{kind}_of(real x)", "x != x", "0", bounded)
    return text


def _function(prototype: str, condition: str, then: str, otherwise: str) -> str:
    return f"\nstatic inline {prototype}\n{{\n    if ({condition}) return {then};\n    return {otherwise};\n}}\n"
