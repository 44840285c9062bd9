"""Exports JAX functions as C99 source without dependencies, with a demo program and a CMake file.

The source holds constant tables and functions of one state: no allocation, no mutable state outside the stack, no
library but <math.h>. The same functions, name and precision give the same files, byte for byte.
"""

import importlib.metadata
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
    Leaf,
    Signature,
    argument_leaves,
    declaration,
    description,
    result_leaves,
)
from dln_jax.export.c.jaxprs import repeated_calls, traced
from dln_jax.export.c.lowering import program_of
from dln_jax.export.c.text import PRECISIONS, check_name, comment, kind_of, table
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
_RELIED_ON = """\
#if defined __FAST_MATH__ || defined __ASSOCIATIVE_MATH__ || defined _M_FP_FAST || __FINITE_MATH_ONLY__ + 0
#error "NaN, infinities and rounding are relied on: leave out -ffast-math and what it stands for"
#endif
"""
_NEEDED = """C99; needs <math.h>, <float.h> and <stdint.h>, and nothing else. Fastest with -O3 for the processor at hand
(gcc: -march=native); does not compile with -ffast-math, which gives wrong numbers."""


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
    version, real = importlib.metadata.version("dln-jax"), PRECISIONS[precision][1]
    written_by = f"Written by dln-jax {version}, C format {FORMAT}."
    files = {
        f"{name}.h": _header(name, written_by, signatures, real, left_out),
        f"{name}.c": comment(f"{name}.c", written_by, _NEEDED)
        + _preamble(source, name)
        + "".join(dict.fromkeys(part.text for part in source.parts.values()))
        + "".join(texts),
        f"{name}_demo.c": demo(name, signatures, precision),
        "CMakeLists.txt": cmake(name),
    }
    if casadi:
        chosen = {
            key: pair for key, pair in functions.items() if key in signatures and (casadi is True or key in casadi)
        }
        with computing_in(precision):
            files |= _for_casadi(chosen, name, libm, precision, written_by, leave_out_large, stack)
    if (longest := max(map(len, files.values()))) > LENGTH:
        raise InputError(f"the source would take {longest / 1e6:.0f} MB; generated C suits up to {LENGTH / 1e6:.0f} MB")
    encoded = {file_name: text.encode() for file_name, text in files.items()}
    return {**encoded, f"{name}.json": described(description(name, precision, version, signatures), encoded)}


def _exported(
    functions: Functions, source: Source, name: str, leave_out_large: bool, stack: int
) -> tuple[Source, dict[str, Signature], list[str], list[str]]:
    """Returns the source, signatures and texts of the functions, and why functions were left out."""
    signatures, texts, left_out = {}, [], []
    every = {
        check_name(key, "the name of a function"): _traced(key, *pair, source.precision)
        for key, pair in functions.items()
    }
    repeated = repeated_calls([function.closed for function in every.values()])
    for key, traced_function in every.items():
        before = source.copy()
        try:
            signature, text, lines = _function(source, name, key, traced_function, repeated, stack)
            if leave_out_large and lines > LINES:
                raise TooLargeError(f"{key}, of {lines} lines")
        except TooLargeError as error:
            if not leave_out_large:
                raise
            left_out.append(str(error))
            source = before
            continue
        signatures[key] = signature
        texts.append(text)
    return source, signatures, texts, left_out


def _for_casadi(
    functions: Functions, name: str, libm: bool, precision: str, written_by: str, leave_out: bool, stack: int
) -> dict[str, str]:
    if precision != "f64":
        raise InputError("CasADi computes in double; export with precision f64")
    source, text, left_out = external.external_functions(name, functions, libm=libm, stack=stack, leave_out=leave_out)
    absent = "\n".join(f"Left out: {reason}" for reason in left_out)
    about = comment(external.ABOUT.format(name=name, written_by=written_by), *[absent] * bool(absent))
    return {
        f"{name}_casadi.c": about + _preamble(source, name) + text,
        "CMakeLists.txt": cmake(name) + external.BUILD.format(name=name),
    }


class _Traced(NamedTuple):
    arguments: list[Leaf]
    results: list[Leaf]
    closed: Any


def _traced(key: str, function: Callable[..., Any], examples: Sequence[Any], precision: str) -> _Traced:
    numpy_type = PRECISIONS[precision][0]
    try:
        examples = jax.tree.map(lambda leaf: _at(leaf, numpy_type), tuple(examples))
        arguments = argument_leaves(function, examples)
        closed, shapes = traced(function, examples)
        return _Traced(arguments, result_leaves(shapes, arguments), closed)
    except InputError as error:
        raise InputError(f"{key}: {error}") from error


def _function(
    source: Source, name: str, key: str, traced_function: _Traced, repeated: Collection[int], stack: int
) -> tuple[Signature, str, int]:
    """Returns the signature, the C text, and the number of lines, callees included, of a function."""
    signature = Signature(tuple(traced_function.arguments), tuple(traced_function.results))
    named = {k: (leaf.name, leaf.shape == ()) for k, leaf in enumerate(traced_function.arguments)}
    targets = [None] if signature.returns else [leaf.name for leaf in signature.results]
    try:
        program, _, results = program_of(traced_function.closed, repeated, precision=source.precision)
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


def _at(leaf: Any, numpy_type: Any) -> np.ndarray:
    return np.asarray(leaf, numpy_type if kind_of(_type(leaf)) == "real" else None)


def _type(leaf: Any) -> Any:
    return leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype


def _precision(functions: Functions) -> str:
    leaves = jax.tree.leaves([examples for _, examples in functions.values()])
    sizes = {_type(leaf).itemsize for leaf in leaves if jax.numpy.issubdtype(_type(leaf), np.floating)}
    return "f64" if max(sizes, default=8) == 8 else "f32"


def _preamble(source: Source, name: str) -> str:
    """Returns the part of a source before its functions."""
    real, suffix = PRECISIONS[source.precision][1], source.suffix
    tables = "\n".join(table(table_name, array, source.precision) for table_name, array in source.tables.values())
    upper = suffix.upper()
    return (
        f'#include <float.h>\n#include <math.h>\n#include <stdint.h>\n\n#include "{name}.h"\n\n{_RELIED_ON}\n'
        f"typedef {real} real;\n\n"
        "/* Passes of gcc that take as long as all others here, and find nothing */\n"
        "#if defined(__GNUC__) && !defined(__clang__)\n"
        '#pragma GCC optimize("no-gcse", "no-gcse-after-reload")\n#endif\n\n'
        f"/* Of two operations or of one, whichever the processor has */\n#ifdef FP_FAST_FMA{upper}\n"
        f"#define MULTIPLY_ADD(a, b, c) fma{suffix}(a, b, c)\n#else\n"
        f"#define MULTIPLY_ADD(a, b, c) ((a) * (b) + (c))\n#endif\n"
        "#ifdef __cplusplus\n#define RESTRICT\n#else\n#define RESTRICT restrict\n#endif\n\n"
        f"{tables}{definitions(source.functions, source.precision, arrays=source.arrays)}"
        f"{operations.definitions(source.integers, source.precision)}{kernels.orderings(source.orders)}"
        f"{factorisations.definitions(source.kernels, suffix)}"
    )


def _header(name: str, written_by: str, signatures: Mapping[str, Signature], real: str, left_out: Sequence[str]) -> str:
    absent = "\n".join(f"Left out: {reason}; ask for it by name." for reason in left_out)
    about, guard = comment(f"{name}.h", written_by, _PROMISES, *[absent] * bool(absent)), f"{name.upper()}_H"
    declared = ""
    for key, signature in signatures.items():
        shapes = ", ".join(f"{leaf.name} {list(leaf.shape)}" for leaf in signature.results if leaf.shape)
        facts = f"{signature.operations} floating-point operations, {signature.stack_bytes} bytes of stack"
        declared += f"\n/* {f'{shapes}; ' if shapes else ''}{facts} */\n{declaration(name, key, signature, real)};\n"
    return (
        f'{about}#ifndef {guard}\n#define {guard}\n\n#include <stdint.h>\n\n#ifdef __cplusplus\nextern "C" {{\n#endif\n'
        f"{declared}\n#ifdef __cplusplus\n}}\n#endif\n\n#endif\n"
    )
