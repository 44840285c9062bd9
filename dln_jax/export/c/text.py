"""Number types of a program, and C text of numbers, tables, comments and names."""

import re
from collections.abc import Mapping
from string import Template
from textwrap import TextWrapper
from typing import Any

import jax
import numpy as np

from dln_jax.types import InputError

C_TYPES: Mapping[str, str] = {
    "real": "real",
    "bool": "int",
    "int": "int32_t",
    "long": "int64_t",
    "unsigned": "uint32_t",
    "unsigned_long": "uint64_t",
    "index": "long long",
}
"""C type of each kind. An `index` counts array elements. Only the program computes it, so it cannot overflow."""
NUMPY_TYPES: Mapping[str, Any] = {
    "bool": np.bool_,
    "int": np.int32,
    "long": np.int64,
    "unsigned": np.uint32,
    "unsigned_long": np.uint64,
    "index": np.int64,
}
"""NumPy type of each kind except `real`, which has the precision of the export."""
SIGNED = ("int", "long")
"""Integer kinds with undefined overflow in C."""
UNSIGNED = ("unsigned", "unsigned_long")
_KINDS = {np.dtype(numpy_type).name: kind for kind, numpy_type in NUMPY_TYPES.items() if kind != "index"}
# JAX gives integers tangents of the type float0; no program computes with them.
_KINDS |= {"float32": "real", "float64": "real", str(jax.dtypes.float0): "bool"}
PRECISIONS = {"f32": (np.float32, "float", "f"), "f64": (np.float64, "double", "")}
"""NumPy type, C type, and the suffix of its literals and of the functions of <math.h>."""
LARGEST = 1 << 22
"""Largest number of elements of an array."""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_FUNCTIONS = """
acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh erf erfc exp exp2 expm1 fabs fdim floor fma fmax fmin
fmod frexp hypot ilogb ldexp lgamma llrint llround log log10 log1p log2 logb lrint lround modf nan nearbyint nextafter
nexttoward pow remainder remquo rint round scalbln scalbn sin sinh sqrt tan tanh tgamma trunc
"""
# Keywords of C99 and C++, headers and functions of their libraries, targets of make, and names that a source defines: a
# function, library or header with such a name would not build, or would hide the original.
_RESERVED = frozenset(
    re.findall(
        r"\w+",
        """
        alignas alignof and asm auto bool break case catch char class compl const constexpr continue decltype default
        delete do double else enum explicit export extern false float for friend goto if inline int long mutable
        namespace new noexcept not nullptr operator or private protected public register restrict return short signed
        sizeof static struct switch template this thread_local throw true try typedef typeid typename union unsigned
        using virtual void volatile while xor
        abort abs assert atol bufsiz clock complex ctype div eof errno exit fenv free gamma index infinity inttypes
        iso646 j0 j1 jn limits locale main malloc math null printf rand real setjmp signal stdarg stdbool stddef stdint
        stdio stdlib string tgmath time wchar wctype y0 y1 yn all clean demo install test cholesky lu triangular_solve
        """
        + _FUNCTIONS
        + re.sub(r"\b(\w+)\b", r"\1f", _FUNCTIONS),
    )
)


def kind_of(dtype: Any) -> str:
    """Returns the kind of a JAX dtype; raises InputError for types without one."""
    if str(dtype) not in _KINDS:
        hint = "draw random numbers beforehand" if str(dtype).startswith("key<") else "cast it to 32 or 64 bits"
        raise InputError(f"an array has type {dtype}, which C export does not support; {hint}")
    return _KINDS[str(dtype)]


def limit(kind: str, *, upper: bool) -> Any:
    """Returns the lower or upper limit of a kind."""
    if kind in ("real", "bool"):
        return upper if kind == "bool" else np.inf if upper else -np.inf
    limits = np.iinfo(NUMPY_TYPES[kind])
    return limits.max if upper else limits.min


def failure(kind: str) -> Any:
    """Returns the value of a missing result: NaN, the largest integer or true."""
    return np.nan if kind == "real" else limit(kind, upper=True)


def check_name(name: str, what: str = "name") -> str:
    """Returns a valid C name; raises InputError for any other."""
    taken = name.lower() in _RESERVED or re.fullmatch(r"(v|c|n|t|i|table|part)_?\d\w*|elementary_.*|.*_", name)
    if not _NAME.fullmatch(name) or taken or len(name) > 40:
        raise InputError(
            f"{what} is {name!r:.60}; expected a C name: a letter, then letters, digits or _, at most 40, no "
            "keyword of C or C++ and no name that their libraries or the source define"
        )
    return name


def fill(text: str, precision: str, **values) -> str:
    """Returns the text with `$name` replaced; `${f}` is the suffix of literals and functions, `$real` the C type."""
    return Template(text).substitute(f=PRECISIONS[precision][2], real=PRECISIONS[precision][1], **values)


def number(value, precision: str, kind: str = "real") -> str:
    """Returns the shortest literal of a number; raises InputError if the precision cannot represent it.

    The lowest 32- and 64-bit integers have no literal in C and use names.
    """
    if kind != "real":
        lowest = {-(2**31): "INT32_MIN", -(2**63): "INT64_MIN"}
        suffix = {"unsigned": "U", "unsigned_long": "ULL"}.get(kind, "")
        return lowest.get(int(value), f"{int(value)}{suffix}")
    numpy_type, _, suffix = PRECISIONS[precision]
    if not np.isfinite(value):
        return "(real)NAN" if value != value else "(real)INFINITY" if value > 0 else "-(real)INFINITY"
    with np.errstate(over="ignore"):
        rounded = numpy_type(value)
    if not np.isfinite(rounded):
        raise InputError(f"a constant is {value}, beyond the range of {precision}; export in f64")
    return f"{rounded!s}{suffix}"


def literal(value, precision: str, kind: str = "real") -> str:
    """Returns a number for use in an expression, in parentheses if negative."""
    text = number(value, precision, kind)
    return f"({text})" if text.startswith(("-", "INT")) else text


_wrapper = TextWrapper(116, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)


def table(name: str, array: np.ndarray, precision: str) -> str:
    """Returns the definition of a constant array."""
    kind = "real" if array.dtype.kind == "f" else kind_of(array.dtype)
    lines = "\n".join(_wrapper.wrap(" ".join(f"{number(value, precision, kind)}," for value in array.ravel())))
    return f"static const {C_TYPES[kind]} {name}[{array.size}] = {{\n{lines}\n}};\n"


def comment(*paragraphs: str) -> str:
    """Returns a block comment with its lines unchanged."""
    return "/*\n" + "".join(f" * {line}".rstrip() + "\n" for line in "\n\n".join(paragraphs).splitlines()) + " */\n"
