"""Exports JAX functions as C99 source without dependencies, with a demo program and a CMake file.

The source holds constant tables and functions of one state, with no allocation, no mutable state outside the stack and
no library but <math.h>. The same functions, name and precision give the same files, byte for byte.
"""

import functools
import importlib.metadata
import re
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dln_jax.export.c import casadi as external
from dln_jax.export.c.body import Source
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
from dln_jax.export.c.templates import CASADI_ABOUT, CASADI_BUILD, NEEDED, about, cmake, demo, header, preamble
from dln_jax.export.c.text import PRECISIONS, check_name, comment, kind_of
from dln_jax.export.exports import write_exports
from dln_jax.precision import computing_in
from dln_jax.types import InputError, require_positive

Functions = Mapping[str, tuple[Callable[..., Any], Sequence[Any]]]
"""Functions of arrays by name, with example arguments."""
STACK = 256 * 1024
"""Default limit in bytes of the stack that a function may use."""
LENGTH = 10_000_000
"""Largest size of a source in bytes."""
LINES = 4000
"""A function of more lines, including callees, is not exported by default."""


class TooLargeError(InputError):
    """A function needs more stack, or more lines, than suits generated C."""


def export_c(
    functions: Functions,
    directory: str | Path,
    *,
    name: str = "model",
    precision: str | None = None,
    casadi: bool | Collection[str] = False,
    leave_out_large: bool = False,
    stack: int = STACK,
    finite: bool = False,
    loop_bound: int | None = None,
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
        casadi: also write NAME_casadi.c: all functions, or those named, with exact derivatives for CasADi's `external`.
        leave_out_large: omit functions that exceed the stack or 4,000 lines (which take seconds to compile), and from
            NAME_casadi.c functions that CasADi cannot take; the files list the omitted functions.
        stack: bytes of stack that a function may use; a plan over many steps may need more than the default.
        finite: assume finite arguments and intermediate results. Then 0 x = 0, so that the zeros and ones of a
            derivative's structure cost nothing; NaN or infinity may reach fewer results than in JAX.
        loop_bound: bound on the iterations of a `while_loop` whose condition does not compare a counter with a
            constant. A loop that needs more ends with NaN (integers: the largest; booleans: true).
        overwrite: replace existing files.

    Raises:
        InputError: a function cannot be written in C or needs more stack, a name is invalid in C, the source exceeds 10
            MB, files exist, or the folder belongs to a run, whose files are never replaced.
    """
    texts = source_files(
        functions, name=check_name(name), precision=precision, casadi=casadi,
        leave_out_large=leave_out_large, stack=stack, finite=finite, loop_bound=loop_bound,
    )  # fmt: skip
    return write_exports(Path(directory), texts, overwrite=overwrite)


def source_files(
    functions: Functions,
    *,
    name: str,
    precision: str | None = None,
    casadi: bool | Collection[str] = False,
    leave_out_large: bool = False,
    stack: int = STACK,
    finite: bool = False,
    loop_bound: int | None = None,
) -> dict[str, bytes]:
    """Returns the contents of the files by name; arguments as for `export_c`."""
    require_positive(stack=stack, loop_bound=1 if loop_bound is None else loop_bound)
    if not functions:
        raise InputError("there is no function to export; give at least one, as {'name': (function, examples)}")
    for key, pair in functions.items():
        if not (isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[1], tuple | list)):
            raise InputError(
                f"{key} is {pair!r:.60}; expected (function, examples), one example for each argument: (f, (x,))"
            )
    functions = {key: (_in_written_order(function), examples) for key, (function, examples) in functions.items()}
    precision = precision or _precision(functions)
    if precision not in PRECISIONS:
        raise InputError(f"precision is {precision!r}; expected f32 or f64")
    with computing_in(precision):
        source, signatures, texts, left_out = _exported(
            functions, Source(precision, finite, loop_bound), name, leave_out_large, stack
        )
        version = importlib.metadata.version("dln-jax")
        written_by = f"Written by dln-jax {version}, C format {FORMAT}."
        parts = dict.fromkeys(part.text for part in source.parts.values())
        files = {
            f"{name}.h": header(name, written_by, signatures, precision, left_out),
            f"{name}.c": comment(f"{name}.c", written_by, NEEDED) + "".join([preamble(source, name), *parts, *texts]),
            f"{name}_demo.c": demo(name, signatures, precision),
            "CMakeLists.txt": cmake(name),
        }
        if casadi:
            if precision != "f64":
                raise InputError("CasADi computes in double; export with precision f64")
            chosen = {key: functions[key] for key in signatures if casadi is True or key in casadi}
            source, text, left_out = external.external_functions(
                name, chosen, Source("f64", finite, loop_bound), stack=stack, leave_out=leave_out_large
            )
            title = about(CASADI_ABOUT.format(name=name, written_by=written_by), left_out=left_out)
            files[f"{name}_casadi.c"] = title + preamble(source, name) + text
            files["CMakeLists.txt"] += CASADI_BUILD.format(name=name)
    if (longest := max(map(len, files.values()))) > LENGTH:
        raise InputError(f"the source would take {longest / 1e6:.0f} MB; generated C suits up to {LENGTH / 1e6:.0f} MB")
    encoded = {file_name: text.encode() for file_name, text in files.items()}
    return {**encoded, f"{name}.json": description(name, precision, version, signatures, encoded)}


def _in_written_order(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the function with its results in the order in which a dictionary was written; JAX would sort the keys."""

    def ordered(tree: Any) -> Any:
        return OrderedDict((key, ordered(value)) for key, value in tree.items()) if type(tree) is dict else tree

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        return ordered(function(*arguments))

    return call


def _precision(functions: Functions) -> str:
    types = [array_of(leaf).dtype for leaf in jax.tree.leaves([examples for _, examples in functions.values()])]
    sizes = {dtype.itemsize for dtype in types if jax.numpy.issubdtype(dtype, np.floating)}
    return "f64" if max(sizes, default=8) == 8 else "f32"


def _exported(
    functions: Functions, source: Source, name: str, leave_out_large: bool, stack: int
) -> tuple[Source, dict[str, Signature], list[str], list[str]]:
    """Returns the source, signatures and texts of the functions, and reasons for those left out."""
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
    """Returns the signature, without costs, and the closed jaxpr of a function."""

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
    """Returns the signature with costs, the C text, and the number of lines of a function, including callees."""
    named = {k: (leaf.name, leaf.shape == ()) for k, leaf in enumerate(signature.arguments)}
    targets = [leaf.name for leaf in signature.written]
    try:
        program, _, results = program_of(closed, repeated, precision=source.precision, finite=source.finite)
        body = body_of(source, program, results, named, targets)
    except InputError as error:
        raise InputError(f"{key}: {error}") from error
    if body.stack > stack:
        raise TooLargeError(
            f"{key} would take {body.stack / 1024:.0f} KiB of stack; generated C suits up to {stack // 1024} KiB"
        )
    words = set(re.findall(r"\w+", "\n".join(body.lines)))
    leaves = [*signature.arguments, *signature.written]
    lines = "\n".join([*(f"    (void){leaf.name};" for leaf in leaves if leaf.name not in words), *body.lines])
    text = f"\n{declaration(name, key, signature, 'real')}\n{{\n{lines}\n}}\n"
    total = len(body.lines) + sum(source.parts[part].text.count("\n") for part in body.calls)
    return signature._replace(cost=body.cost), text, total
