"""Exports JAX functions as C99 source without dependencies, with a demo program and a CMake file.

The source holds constant tables and functions of one state: no allocation, no mutable state outside the stack, no
library but <math.h>. The same functions, name and precision give the same files, byte for byte.
"""

import importlib.metadata
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dln_jax.export.c import casadi as external
from dln_jax.export.c import factorisations, kernels, operations
from dln_jax.export.c.body import Source
from dln_jax.export.c.demo import cmake, demo
from dln_jax.export.c.elementary import definitions
from dln_jax.export.c.emit import body_of
from dln_jax.export.c.interface import (
    FORMAT,
    Signature,
    argument_leaves,
    array_of,
    declaration,
    description,
    result_leaves,
)
from dln_jax.export.c.jaxprs import repeated_calls, traced
from dln_jax.export.c.lowering import program_of
from dln_jax.export.c.text import PRECISIONS, check_name, comment, fill, kind_of, table
from dln_jax.export.exports import described, write_exports
from dln_jax.precision import computing_in
from dln_jax.types import InputError, require_positive

Functions = Mapping[str, tuple[Callable[..., Any], Sequence[Any]]]
"""Functions of arrays by name, with example arguments."""
STACK = 256 * 1024
"""Default limit of the stack that a function may use, in bytes."""
LENGTH = 10_000_000
"""Largest length of a source in bytes."""
LINES = 4000
"""Largest size in lines, including callees, at which a function is exported by default."""


class TooLargeError(InputError):
    """A function needs more stack, or more lines, than generated C suits."""


_PROMISES = """Functions of one state, which keep their workspace on the stack and may run in several threads.
Results may overlap arguments, as updates in place do, but not each other: all arguments are read before results are
written. What is not finite in a state is not hidden."""
_NEEDED = """C99; needs <math.h>, <float.h> and <stdint.h>, and nothing else. Fastest with -O3 for the processor at hand
(gcc: -march=native); does not compile with -ffast-math, which gives wrong numbers."""
_PREAMBLE = """\
#include <float.h>
#include <math.h>
#include <stdint.h>

#include "$name.h"

#if defined __FAST_MATH__ || defined __ASSOCIATIVE_MATH__ || defined _M_FP_FAST || __FINITE_MATH_ONLY__ + 0
#error "NaN, infinities and rounding are relied on: leave out -ffast-math and what it stands for"
#endif

typedef $real real;

/* Passes of gcc that take as long as all others here, and find nothing */
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("no-gcse", "no-gcse-after-reload")
#endif

/* Of two operations or of one, whichever the processor has */
#ifdef FP_FAST_FMA$upper
#define MULTIPLY_ADD(a, b, c) fma${f}(a, b, c)
#else
#define MULTIPLY_ADD(a, b, c) ((a) * (b) + (c))
#endif
#ifdef __cplusplus
#define RESTRICT
#else
#define RESTRICT restrict
#endif

"""
_HEADER = """\
#ifndef $guard
#define $guard

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif
$declared
#ifdef __cplusplus
}
#endif

#endif
"""


def export_c(
    functions: Functions,
    directory: str | Path,
    *,
    name: str = "model",
    precision: str | None = None,
    libm: bool = False,
    casadi: bool | Collection[str] = False,
    leave_out_large: bool = False,
    stack: int = STACK,
    overwrite: bool = False,
) -> list[Path]:
    """Writes NAME.h, NAME.c, NAME_demo.c, NAME.json and CMakeLists.txt, and returns their paths.

    Args:
        functions: name -> (function, examples): a function with its parameters closed over, and one example per
            argument, an array or a tree of arrays. C arguments are named after the function's parameters, C results
            after the keys of a dictionary or the fields of a named tuple.
        directory: folder of the export; created if missing.
        name: a C name; every file and public function starts with it.
        precision: f32 or f64, for all real numbers; default: the precision of the examples.
        libm: call the C library's exp, expm1, tanh, sin, cos, log and log1p instead of vectorisable ones.
        casadi: also write NAME_casadi.c, the functions with exact derivatives for CasADi's `external`; a collection
            names the functions to include.
        leave_out_large: omit functions that exceed the stack or 4,000 lines (which take seconds to compile), and from
            NAME_casadi.c functions that CasADi cannot take; the files list what is missing.
        stack: bytes of stack that a function may use; a plan over many steps may need more than the default.
        overwrite: replace existing files.

    Raises:
        InputError: a function has no C or needs more stack, a name is invalid in C, the source exceeds 10 MB, files
            exist, or the folder belongs to a run, whose files are never replaced.
    """
    texts = source_files(
        functions, name=check_name(name), precision=precision, libm=libm, casadi=casadi,
        leave_out_large=leave_out_large, stack=stack,
    )  # fmt: skip
    return write_exports(Path(directory), texts, overwrite=overwrite)


def source_files(
    functions: Functions,
    *,
    name: str,
    precision: str | None = None,
    libm: bool = False,
    casadi: bool | Collection[str] = False,
    leave_out_large: bool = False,
    stack: int = STACK,
) -> dict[str, bytes]:
    """Returns the contents of the files by name; arguments as for `export_c`."""
    require_positive(stack=stack)
    if not functions:
        raise InputError("there is no function to export; give at least one, as {'name': (function, examples)}")
    precision = precision or _precision(functions)
    if precision not in PRECISIONS:
        raise InputError(f"precision is {precision!r}; expected f32 or f64")
    with computing_in(precision):
        source, signatures, texts, left_out = _exported(
            functions, Source(precision, libm), name, leave_out_large, stack
        )
        version = importlib.metadata.version("dln-jax")
        written_by = f"Written by dln-jax {version}, C format {FORMAT}."
        parts = dict.fromkeys(part.text for part in source.parts.values())
        files = {
            f"{name}.h": _header(name, written_by, signatures, precision, left_out),
            f"{name}.c": comment(f"{name}.c", written_by, _NEEDED) + "".join([_preamble(source, name), *parts, *texts]),
            f"{name}_demo.c": demo(name, signatures, precision),
            "CMakeLists.txt": cmake(name),
        }
        if casadi:
            if precision != "f64":
                raise InputError("CasADi computes in double; export with precision f64")
            chosen = {key: functions[key] for key in signatures if casadi is True or key in casadi}
            source, text, left_out = external.external_functions(
                name, chosen, libm=libm, stack=stack, leave_out=leave_out_large
            )
            about = _about(external.ABOUT.format(name=name, written_by=written_by), left_out=left_out)
            files[f"{name}_casadi.c"] = about + _preamble(source, name) + text
            files["CMakeLists.txt"] += external.BUILD.format(name=name)
    if (longest := max(map(len, files.values()))) > LENGTH:
        raise InputError(f"the source would take {longest / 1e6:.0f} MB; generated C suits up to {LENGTH / 1e6:.0f} MB")
    encoded = {file_name: text.encode() for file_name, text in files.items()}
    return {**encoded, f"{name}.json": described(description(name, precision, version, signatures), encoded)}


def _precision(functions: Functions) -> str:
    types = [array_of(leaf).dtype for leaf in jax.tree.leaves([examples for _, examples in functions.values()])]
    sizes = {dtype.itemsize for dtype in types if jax.numpy.issubdtype(dtype, np.floating)}
    return "f64" if max(sizes, default=8) == 8 else "f32"


def _exported(
    functions: Functions, source: Source, name: str, leave_out_large: bool, stack: int
) -> tuple[Source, dict[str, Signature], list[str], list[str]]:
    """Returns the source, signatures and texts of the functions, and why functions were left out."""
    signatures, texts, left_out = {}, [], []
    every = {
        check_name(key, "the name of a function"): _traced(key, *pair, source.precision)
        for key, pair in functions.items()
    }
    repeated = repeated_calls([closed for _, closed in every.values()])
    for key, (signature, closed) in every.items():
        with_function = source.copy()
        try:
            signature, text, lines = _function(with_function, name, key, signature, closed, repeated, stack)
            if leave_out_large and lines > LINES:
                raise TooLargeError(f"{key}, of {lines} lines")
        except TooLargeError as error:
            if not leave_out_large:
                raise
            left_out.append(f"{error}; ask for it by name.")
            continue
        source, signatures[key] = with_function, signature
        texts.append(text)
    return source, signatures, texts, left_out


def _traced(key: str, function: Callable[..., Any], examples: Sequence[Any], precision: str) -> tuple[Signature, Any]:
    """Returns the signature, still without costs, and the closed jaxpr of a function."""

    def cast(leaf: Any) -> np.ndarray:
        array = array_of(leaf)
        return np.asarray(array, PRECISIONS[precision][0] if kind_of(array.dtype) == "real" else None)

    try:
        examples = jax.tree.map(cast, tuple(examples))
        arguments = argument_leaves(function, examples)
        closed, shapes = traced(function, examples)
        return Signature(tuple(arguments), tuple(result_leaves(shapes, arguments))), closed
    except InputError as error:
        raise InputError(f"{key}: {error}") from error


def _function(
    source: Source, name: str, key: str, signature: Signature, closed: Any, repeated: Collection[int], stack: int
) -> tuple[Signature, str, int]:
    """Returns the signature with costs, the C text, and the number of lines, callees included, of a function."""
    named = {k: (leaf.name, leaf.shape == ()) for k, leaf in enumerate(signature.arguments)}
    targets = [None] if signature.returns else [leaf.name for leaf in signature.results]
    try:
        program, _, results = program_of(closed, repeated, precision=source.precision)
        body = body_of(source, program, results, named, targets)
    except InputError as error:
        raise InputError(f"{key}: {error}") from error
    if body.bytes > stack:
        raise TooLargeError(
            f"{key} would take {body.bytes / 1024:.0f} KiB of stack; generated C suits up to {stack // 1024} KiB"
        )
    words = set(re.findall(r"\w+", "\n".join(body.lines)))
    leaves = [*signature.arguments, *(() if signature.returns else signature.results)]
    lines = "\n".join([*(f"    (void){leaf.name};" for leaf in leaves if leaf.name not in words), *body.lines])
    text = f"\n{declaration(name, key, signature, 'real')}\n{{\n{lines}\n}}\n"
    total = len(body.lines) + sum(source.parts[part].text.count("\n") for part in body.calls)
    return signature._replace(stack_bytes=body.bytes, operations=body.operations), text, total


def _preamble(source: Source, name: str) -> str:
    """Returns the part of a source before its functions."""
    precision = source.precision
    tables = "".join(f"{table(*named, precision)}\n" for named in source.tables.values())
    return "".join((
        fill(_PREAMBLE, precision, name=name, upper=source.suffix.upper()),
        tables.removesuffix("\n"),
        definitions(source.functions, precision, arrays=source.arrays),
        operations.definitions(source.integers, precision),
        kernels.orderings(source.orders),
        factorisations.definitions(source.kernels, source.suffix),
    ))  # fmt: skip


def _header(
    name: str, written_by: str, signatures: Mapping[str, Signature], precision: str, left_out: Sequence[str]
) -> str:
    declared = ""
    for key, signature in signatures.items():
        shapes = "".join(f"{leaf.name} {list(leaf.shape)}, " for leaf in signature.results if leaf.shape)
        facts = f"{signature.operations} floating-point operations, {signature.stack_bytes} bytes of stack"
        prototype = declaration(name, key, signature, PRECISIONS[precision][1])
        declared += f"\n/* {f'{shapes[:-2]}; ' if shapes else ''}{facts} */\n{prototype};\n"
    about = _about(f"{name}.h", written_by, _PROMISES, left_out=left_out)
    return about + fill(_HEADER, precision, guard=f"{name.upper()}_H", declared=declared)


def _about(*paragraphs: str, left_out: Sequence[str]) -> str:
    """Returns a comment that also lists the functions left out, and why."""
    absent = "\n".join(f"Left out: {reason}" for reason in left_out)
    return comment(*paragraphs, *[absent] * bool(absent))
