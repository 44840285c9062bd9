"""Pieces of C text: numbers, tables, comments and names."""

import re
from string import Template
from textwrap import TextWrapper

import numpy as np

from dln_jax.types import InputError

PRECISIONS = {"f32": (np.float32, "float", "f"), "f64": (np.float64, "double", "")}
"""NumPy type, C type, and the suffix of its literals and of the functions of <math.h>."""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
# C99 and C++ keywords that fit the pattern; a library or a header of that name would not build.
_RESERVED = frozenset(
    re.findall(
        r"\w+",
        """
        auto bool break case catch char class const continue default delete do double else enum export extern false
        float for friend goto if inline int long mutable namespace new operator private protected public register
        restrict return short signed sizeof static struct switch template this throw true try typedef typename union
        unsigned using virtual void volatile while main real test demo all clean install
        """,
    )
)


def check_name(name: str) -> str:
    """A name that may start every C name of a model; InputError otherwise."""
    if not _NAME.fullmatch(name) or name.lower() in _RESERVED or len(name) > 40:
        raise InputError(
            f"name is {name!r}; expected a C name: a letter, then letters, digits or _, at most 40, and no C keyword"
        )
    return name


def fill(text: str, precision: str, **values) -> str:
    """The text with `$name` replaced; `${f}` is the suffix of literals and functions, and `real` the C type."""
    return Template(text).substitute(f=PRECISIONS[precision][2], real=PRECISIONS[precision][1], **values)


def number(value, precision: str) -> str:
    """The shortest literal that reads back as the same number.

    Raises InputError where it is not finite, or too large for the precision.
    """
    numpy_type, _, suffix = PRECISIONS[precision]
    with np.errstate(over="ignore"):
        rounded = numpy_type(value)
    if not np.isfinite(rounded):
        raise InputError(f"a parameter is {value}, which {precision} cannot hold; train again, or export in f64")
    return f"{rounded!s}{suffix}"


_wrapper = TextWrapper(116, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)


def table(name: str, values, precision: str) -> str:
    """A constant array, row by row."""
    rows = np.atleast_2d(np.asarray(values))
    size = " * ".join(map(str, np.shape(values)))
    lines = [line for row in rows for line in _wrapper.wrap(" ".join(f"{number(value, precision)}," for value in row))]
    return f"static const real {name}[{size}] = {{\n" + "\n".join(lines) + "\n};\n"


def friction_table(coefficients, precision: str) -> str:
    """The table of viscous friction, nothing for None."""
    if coefficients is None:
        return ""
    return "\n/* Viscous friction, N m s or N s/m */\n" + table("friction", coefficients, precision)


def comment(*paragraphs: str) -> str:
    """A block comment of lines as given."""
    return "/*\n" + "".join(f" * {line}".rstrip() + "\n" for line in "\n\n".join(paragraphs).splitlines()) + " */\n"
