"""Exported C as Python functions: compiled with the C compiler at hand, called through ctypes."""

import collections
import ctypes
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.deploy.c.interface import Leaf, Signature, read_interface
from dln_jax.deploy.c.text import PRECISIONS, check_name
from dln_jax.deploy.low_latency import as_shaped
from dln_jax.types import InputError

FLAGS = ("-O3", "-march=native")
"""Optimisation for the machine that compiles; sums are not reordered."""
WARNINGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror")
_TYPES = {"bool": np.int32, "int": np.int32, "long": np.int64, "unsigned": np.uint32, "unsigned_long": np.uint64}


def load_c(
    directory: str | Path, *, name: str = "model", compiler: str | None = None, flags: Sequence[str] = FLAGS
) -> Any:
    """Compiles an export in a temporary folder, and loads it as a named tuple of its functions.

    Each takes NumPy arrays (or lists of numbers) by position or name, refuses others than of the exported shapes with
    `InputError`, and gives its one result, or a named tuple of them. It keeps buffers between calls: not for two
    threads at once, which load a copy each.

    What is there is compiled and run: take a folder only from whom you trust. The digests in the description tell that
    a file was altered or does not belong to the others, not who wrote them.

    Args:
        directory: with the files that `export_c` wrote.
        name: of the export.
        compiler: by default $CC, cc, gcc or clang, whichever is there first.
        flags: for the compiler, beside those that make a C99 library without warnings.

    Raises:
        InputError: files are missing, altered or of another format, or there is no compiler, or it fails.
    """
    precision, signatures, sources = read_interface(Path(directory), check_name(name))
    try:
        with tempfile.TemporaryDirectory() as folder:
            # Compiled is what was checked, whatever happens to the folder meanwhile.
            for file_name, content in sources.items():
                (Path(folder) / file_name).write_bytes(content)
            source, built = Path(folder) / f"{name}.c", Path(folder) / f"lib{name}.so"
            compile_c([*WARNINGS, *flags, "-fPIC", "-shared", str(source), "-lm", "-o", str(built)], compiler)
            # The functions take microseconds: handing the interpreter's lock on and back would take longer.
            library = ctypes.PyDLL(str(built))
    except OSError as error:
        raise InputError(f"{directory}: not to be built in a temporary folder ({error}); set TMPDIR") from error
    types = {**_TYPES, "real": PRECISIONS[precision][0]}
    made = {key: _bound(getattr(library, f"{name}_{key}"), key, each, types) for key, each in signatures.items()}
    return collections.namedtuple("Functions", made)(**made)


def compile_c(arguments: Sequence[str], compiler: str | None = None) -> None:
    """Runs a C compiler; InputError where there is none, or where it fails."""
    names = [compiler] if compiler else [os.environ.get("CC", "cc"), "cc", "gcc", "clang"]
    found = next((path for candidate in names if candidate and (path := shutil.which(candidate))), None)
    if found is None:
        raise InputError(f"no C compiler ({', '.join(names)}) on the PATH; install gcc or clang, or set CC")
    result = subprocess.run([found, *arguments], capture_output=True, text=True, errors="replace")
    if result.returncode:
        complaint = next((line for line in result.stderr.splitlines() if "error" in line), result.stderr.strip())
        raise InputError(f"{found} could not compile the model: {complaint}; export it again, or name other flags")


def _bound(function: Any, name: str, signature: Signature, types: dict[str, Any]) -> Callable[..., Any]:
    """A C function with buffers whose addresses are converted once: a call copies numbers in and out."""

    def buffer(leaf: Leaf) -> np.ndarray:
        return np.zeros(leaf.shape, types[leaf.kind])

    arguments, results = [list(map(buffer, leaves)) for leaves in (signature.arguments, signature.results)]
    names = [leaf.name for leaf in signature.arguments]
    of_arrays = all(leaf.shape for leaf in signature.arguments)
    passed = [array if leaf.shape else None for array, leaf in zip(arguments, signature.arguments, strict=True)]
    written = [] if signature.returns else results
    pointers = [None if array is None else ctypes.c_void_p(array.ctypes.data) for array in (*passed, *written)]
    scalar = [np.ctypeslib.as_ctypes_type(array.dtype) for array in arguments]
    function.restype = np.ctypeslib.as_ctypes_type(results[0].dtype) if signature.returns else None
    call = functools.partial(function, *pointers) if of_arrays else None
    group = collections.namedtuple(f"{name}_results", [leaf.name for leaf in signature.results])
    shapes, copy = [array.shape for array in arguments], results[0].copy

    def evaluate(*given, **named):
        if named:
            given = (*given, *(named.pop(each) for each in names[len(given) :] if each in named))
        if named or len(given) != len(names):
            raise InputError(f"{name} takes {', '.join(names)}; got {len(given)} of them{' and others' * bool(named)}")
        for each, array, shape, label in zip(given, arguments, shapes, names, strict=True):
            # Arrays of the right shape pass in a fraction of a microsecond; others go the long way.
            try:
                fits = each.shape == shape
            except AttributeError:
                fits = False
            array[...] = each if fits else as_shaped(label, each, shape)
        if call is not None:
            returned = call()
        else:
            values = zip(pointers, arguments, scalar, strict=False)
            converted = [each if each is not None else kind(array.item()) for each, array, kind in values]
            returned = function(*converted, *pointers[len(arguments) :])
        if signature.returns:
            return returned
        return copy() if len(results) == 1 else group(*(array.copy() for array in results))

    return evaluate
