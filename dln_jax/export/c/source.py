"""Exports JAX functions as C99 source without dependencies, with a demo program and a CMake file.

The source holds constant tables and functions of one state, with no allocation, no mutable state outside the stack and
no library but <math.h>. The same functions, name and precision give the same files, byte for byte.
"""

import functools
import importlib.metadata
from collections import OrderedDict
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dln_jax.export.c import casadi as external
from dln_jax.export.c.body import Source
from dln_jax.export.c.emit import body_of
from dln_jax.export.c.interface import (
    FORMAT,
    Function,
    Signature,
    declaration,
    description,
    signature_of,
)
from dln_jax.export.c.lowering import program_of, repeated_calls, traced
from dln_jax.export.c.templates import CMAKE, NEEDED, demo, header, preamble
from dln_jax.export.c.text import PRECISIONS, check_name, comment, kind_of
from dln_jax.files import writing
from dln_jax.precision import computing_in, require_precision
from dln_jax.types import InputError, require_positive

STACK = 256 * 1024
"""Default limit in bytes of the stack that a function may use."""
LENGTH = 10_000_000
"""Largest size of a source in bytes."""
LINES = 4000
"""Largest size in lines, including callees, of a function exported by default."""


def export_c(
    functions: Mapping[str, tuple[Function, Sequence[Any]]],
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
    """Exports functions of one state as C99: NAME.h, NAME.c, NAME_demo.c, NAME.json and CMakeLists.txt.

    The C code allocates no memory and needs only <math.h>. It gives the numbers of JAX, up to rounding. The header
    states shapes and units. `load_c` calls the code from Python.

    Args:
        functions: name -> (function, examples): a function with its parameters closed over, and one example per
            argument, an array or a tree of arrays. C arguments are named after the function's parameters, C results
            after the keys of a dictionary or the fields of a named tuple.
        directory: folder of the export; created if missing.
        name: a C name; every file and public function starts with it.
        precision: f32 or f64, for all real numbers; default: the precision of the examples.
        casadi: also write NAME_casadi.c: all functions, or the named ones, with exact derivatives for CasADi's
            `external`.
        leave_out_large: omit functions that exceed the stack or 4,000 lines (which take seconds to compile), and from
            NAME_casadi.c functions that CasADi cannot use; the files list the omitted functions.
        stack: bytes of stack that a function may use; a plan over many steps may need more than the default.
        finite: assume finite arguments and intermediate results. Then 0 x = 0, so structural zeros and ones of
            derivatives cost nothing. NaN or infinity may reach fewer results than in JAX.
        loop_bound: largest number of iterations of a `while_loop` without a counter in its condition. A loop that needs
            more ends with NaN (integers: the largest; booleans: true).
        overwrite: replace existing files.

    Returns:
        The paths of the files.

    Raises:
        InputError: a function cannot be written in C or needs more stack, a name is invalid in C, the source exceeds 10
            MB, files exist, or the folder belongs to a run (runs are never overwritten).

    Example:
        >>> import numpy as np
        >>> import dln_jax
        >>> cart = dln_jax.dynamics(dln_jax.LagrangianSystem(lambda q, qd: 1.5 * qd @ qd))
        >>> paths = dln_jax.export_c({"torque": (cart.inverse_dynamics, tuple(np.ones((3, 1))))}, "cart-c")
        >>> print(*[path.name for path in paths])
        model.h model.c model_demo.c CMakeLists.txt model.json
    """
    require_positive(stack=stack, loop_bound=1 if loop_bound is None else loop_bound)
    check_name(name)
    if not functions:
        raise InputError("there is no function to export; pass at least one: {'name': (function, examples)}")
    chosen: dict[str, tuple[Function, Any]] = {}
    for key, pair in functions.items():
        if not (isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[1], tuple | list)):
            raise InputError(
                f"{key} is {pair!r:.60}; expected (function, examples), one example for each argument: (f, (x,))"
            )
        chosen[check_name(key, "the name of a function")] = _in_written_order(pair[0]), tuple(pair[1])
    if precision is None:
        types = {str(_dtype(leaf)) for leaf in jax.tree.leaves([examples for _, examples in chosen.values()])}
        precision = "f32" if "float32" in types and "float64" not in types else "f64"
    require_precision(precision)
    if casadi and precision != "f64":
        raise InputError("CasADi computes in double precision; export with precision f64")
    version = importlib.metadata.version("dln-jax")
    written_by = f"Written by dln-jax {version}, C format {FORMAT}."
    empty = Source(precision, finite, loop_bound)
    source = empty.copy()
    signatures: dict[str, Signature] = {}
    texts, left_out = [], []
    with computing_in(precision):
        every = {key: _traced(key, *pair, precision) for key, pair in chosen.items()}
        repeated = repeated_calls([closed for _, closed in every.values()])
        for key, (signature, closed) in every.items():
            with_function = source.copy()
            signature, text, lines = _function(with_function, name, key, signature, closed, repeated)
            if (used := signature.cost.stack_bytes) > stack:
                large = f"{key} needs {used / 1024:.0f} KiB of stack; the limit is {stack // 1024} KiB"
            elif leave_out_large and lines > LINES:
                large = f"{key}, of {lines} lines"
            else:
                source, signatures[key] = with_function, signature
                texts.append(text)
                continue
            if not leave_out_large:
                raise InputError(large)
            left_out.append(f"Left out: {large}; ask for it by name.")
        text = "".join([*(part.text for part in source.parts.values()), *texts])
        files = {
            f"{name}.h": header(name, written_by, signatures, precision, left_out),
            f"{name}.c": comment(f"{name}.c", written_by, NEEDED) + preamble(source, name, text) + text,
            f"{name}_demo.c": demo(name, signatures, precision),
            "CMakeLists.txt": CMAKE.format(name=name),
        }
        if casadi:
            of_casadi = {key: chosen[key] for key in signatures if casadi is True or key in casadi}
            source, text, left_out = external.external_functions(
                name, of_casadi, empty, stack=stack, leave_out=leave_out_large
            )
            title = comment(external.ABOUT.format(name=name, written_by=written_by), *left_out)
            files[f"{name}_casadi.c"] = title + preamble(source, name, text) + text
            files["CMakeLists.txt"] += external.BUILD.format(name=name)
    if (longest := max(map(len, files.values()))) > LENGTH:
        raise InputError(f"the source needs {longest / 1e6:.0f} MB; the limit is {LENGTH / 1e6:.0f} MB")
    encoded = {file_name: text.encode() for file_name, text in files.items()}
    stated = description(name, precision, version, signatures, encoded[f"{name}.h"], encoded[f"{name}.c"])
    return _write(Path(directory), {**encoded, f"{name}.json": stated}, overwrite)


def _dtype(leaf: Any) -> np.dtype:
    return leaf.dtype if hasattr(leaf, "dtype") else np.dtype(type(leaf))


def _in_written_order(function: Function) -> Function:
    """Returns the function with dictionaries of results in insertion order; JAX would sort the keys."""

    def ordered(tree):
        return OrderedDict((key, ordered(value)) for key, value in tree.items()) if type(tree) is dict else tree

    @functools.wraps(function)
    def call(*arguments):
        return ordered(function(*arguments))

    return call


def _traced(key: str, function: Function, examples: Any, precision: str) -> tuple[Signature, Any]:
    """Returns the signature, without costs, and the closed jaxpr of a function."""

    def shape_of(leaf):
        dtype = PRECISIONS[precision][0] if kind_of(_dtype(leaf)) == "real" else _dtype(leaf)
        return jax.ShapeDtypeStruct(np.shape(leaf), jax.dtypes.canonicalize_dtype(dtype))

    try:
        examples = jax.tree.map(shape_of, examples)
        closed, shapes = traced(function, examples)
        return signature_of(function, examples, shapes), closed
    except InputError as error:
        raise InputError(f"{key}: {error}") from error


def _function(
    source: Source, name: str, key: str, signature: Signature, closed: Any, repeated: Collection[int]
) -> tuple[Signature, str, int]:
    """Returns the signature with costs, the C text, and the number of lines of a function, including callees."""
    named = {k: (leaf.name, leaf.shape == ()) for k, leaf in enumerate(signature.arguments)}
    targets = [leaf.name for leaf in signature.written]
    try:
        program, _, results = program_of(closed, repeated, precision=source.precision, finite=source.finite)
        body = body_of(source, program, results, named, targets)
    except InputError as error:
        raise InputError(f"{key}: {error}") from error
    unused = [f"    (void){leaf.name};" for leaf in [*signature.arguments, *signature.written]]
    lines = "\n".join(unused + body.lines)
    text = f"\n{declaration(name, key, signature, 'real')}\n{{\n{lines}\n}}\n"
    total = len(body.lines) + sum(source.parts[part].text.count("\n") for part in body.calls)
    return signature._replace(cost=body.cost), text, total


def _write(directory: Path, files: Mapping[str, bytes], overwrite: bool) -> list[Path]:
    """Writes all files or none. The description comes last; `load_c` checks its digest."""
    for path in filter(Path.is_file, directory.glob("*.json")):
        text = path.read_bytes()
        if b'"tensor_file"' in text:
            raise InputError(f"{directory} is the folder of a run; choose another, such as {directory / 'exported'}")
        if path.name in files and b'"functions"' not in text:
            raise InputError(f"{path} does not belong to an export; choose another folder or name")
    existing = [path for name in files if (path := directory / name).exists()]
    for path in existing:
        if not path.is_file():
            raise InputError(f"{path} is not a file and cannot be replaced; choose another folder or name")
    if existing and not overwrite:
        names = ", ".join(path.name for path in existing)
        raise InputError(f"{directory} already contains {names}; choose another folder or overwrite them")
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{directory}: cannot write there ({error.strerror}); choose another folder") from error
    with ExitStack() as stack:
        # All files are complete before the first is renamed; the stack renames in reverse order.
        for name in reversed(list(files)):
            stack.enter_context(writing(directory / name)).write_bytes(files[name])
    return [directory / name for name in files]
