"""C text of numbers, tables, comments and names."""

import re
from string import Template
from textwrap import TextWrapper

import numpy as np

from dln_jax.export.c.kinds import C_TYPES, kind_of
from dln_jax.types import InputError

PRECISIONS = {"f32": (np.float32, "float", "f"), "f64": (np.float64, "double", "")}
"""NumPy type, C type, and the suffix of its literals and of the functions of <math.h>."""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_FUNCTIONS = """
acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh erf erfc exp exp2 expm1 fabs fdim floor fma fmax fmin
fmod frexp hypot ilogb ldexp lgamma llrint llround log log10 log1p log2 logb lrint lround modf nan nearbyint nextafter
nexttoward pow remainder remquo rint round scalbln scalbn sin sinh sqrt tan tanh tgamma trunc
"""
# Keywords of C99 and C++, headers and functions of their libraries, targets of make, and names that a source defines:
# a function, library or header with such a name would not build, or would hide the original.
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


def check_name(name: str, what: str = "name") -> str:
    """Returns a valid name in C, and raises InputError for any other."""
    taken = name.lower() in _RESERVED or re.fullmatch(r"(v|c|n|t|i|table|part)_?\d\w*|elementary_.*|.*_", name)
    if not _NAME.fullmatch(name) or taken or len(name) > 40:
        raise InputError(
            f"{what} is {name!r:.60}; expected a C name: a letter, then letters, digits or _, at most 40, no "
            "keyword of C or C++ and nothing that their libraries or the source itself define"
        )
    return name


def fill(text: str, precision: str, **values) -> str:
    """Returns the text with `$name` replaced; `${f}` is the suffix of literals and functions, `$real` the C type."""
    return Template(text).substitute(f=PRECISIONS[precision][2], real=PRECISIONS[precision][1], **values)


def number(value, precision: str) -> str:
    """Returns the shortest literal of the same number; raises InputError if the precision cannot hold it."""
    numpy_type, _, suffix = PRECISIONS[precision]
    if not np.isfinite(value):
        return "(real)NAN" if value != value else "(real)INFINITY" if value > 0 else "-(real)INFINITY"
    with np.errstate(over="ignore"):
        rounded = numpy_type(value)
    if not np.isfinite(rounded):
        raise InputError(f"a constant is {value}, which {precision} cannot hold; export in f64")
    return f"{rounded!s}{suffix}"


def literal(value, precision: str) -> str:
    """Returns a number for use in an expression, in parentheses if negative."""
    text = number(value, precision)
    return f"({text})" if text.startswith("-") else text


_wrapper = TextWrapper(116, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)


def table(name: str, array: np.ndarray, precision: str) -> str:
    """Returns the definition of a constant array."""
    kind = "real" if array.dtype.kind == "f" else kind_of(array.dtype)
    texts = (number(value, precision) if kind == "real" else integer(int(value), kind) for value in array.ravel())
    lines = "\n".join(_wrapper.wrap(" ".join(f"{text}," for text in texts)))
    return f"static const {C_TYPES[kind]} {name}[{array.size}] = {{\n{lines}\n}};\n"


def integer(value: int, kind: str) -> str:
    """Returns a whole number as a literal; C has none for the lowest of 32 and 64 bits, which have names."""
    lower = {-(2**31): "INT32_MIN", -(2**63): "INT64_MIN"}
    if value in lower:
        return lower[value]
    return str(value) + {"unsigned": "U", "unsigned_long": "ULL"}.get(kind, "")


def comment(*paragraphs: str) -> str:
    """Returns a block comment with the lines unchanged."""
    return "/*\n" + "".join(f" * {line}".rstrip() + "\n" for line in "\n\n".join(paragraphs).splitlines()) + " */\n"
