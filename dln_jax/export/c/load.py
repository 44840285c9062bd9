"""Exported C as Python functions: compiled with the C compiler at hand, called through a binding of its own."""

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dln_jax.export.c.binding import binding, bound
from dln_jax.export.c.interface import read_interface
from dln_jax.export.c.text import check_name
from dln_jax.types import InputError

FLAGS = ("-O3", "-march=native")
"""Optimisation for the machine that compiles; sums are not reordered."""
STANDARD = ("-std=c99", "-pedantic")
# What Python gives is found when the library is loaded.
_UNDEFINED = ("-undefined", "dynamic_lookup") if sys.platform == "darwin" else ()


def load_c(
    directory: str | Path, *, name: str = "model", compiler: str | None = None, flags: Sequence[str] = FLAGS
) -> Any:
    """Compiles an export in a temporary folder, and loads it as a named tuple of its functions.

    Each takes NumPy arrays (or lists of numbers) by position or name, refuses others than of the exported shapes with
    `InputError`, and gives its one result, or a named tuple of them. Fastest are contiguous arrays of the exported type
    by position: others are converted first.

    What is there is compiled and run: take a folder only from whom you trust. The digests in the description tell that
    a file was altered or does not belong to the others, not who wrote them.

    Args:
        directory: with the files that `export_c` wrote.
        name: of the export.
        compiler: by default $CC, cc, gcc or clang, whichever is there first.
        flags: for the compiler, beside those that make a C99 library.

    Raises:
        InputError: files are missing, altered or of another format, or there is no compiler, or it fails.
    """
    precision, signatures, sources = read_interface(Path(directory), check_name(name))
    try:
        with tempfile.TemporaryDirectory() as folder:
            # Compiled is what was checked, whatever happens to the folder meanwhile.
            for file_name, content in sources.items():
                (Path(folder) / file_name).write_bytes(content)
            # No file of an export has a minus in its name.
            between, built = Path(folder) / "for-python.c", Path(folder) / f"lib{name}.so"
            between.write_text(binding(name, signatures, precision))
            texts = [str(Path(folder) / f"{name}.c"), str(between)]
            compile_c([*STANDARD, *flags, "-fPIC", "-shared", *_UNDEFINED, *texts, "-lm", "-o", str(built)], compiler)
            # The functions take microseconds: handing the interpreter's lock on and back would take longer.
            library = ctypes.PyDLL(str(built))
    except OSError as error:
        raise InputError(f"{directory}: not to be built in a temporary folder ({error}); set TMPDIR") from error
    return bound(library, name, signatures, precision)


def compile_c(arguments: Sequence[str], compiler: str | None = None) -> None:
    """Runs a C compiler; InputError where there is none, or where it fails."""
    names = [compiler] if compiler else [os.environ.get("CC", "cc"), "cc", "gcc", "clang"]
    chosen = next((path for candidate in names if candidate and (path := shutil.which(candidate))), None)
    if chosen is None:
        raise InputError(f"no C compiler ({', '.join(names)}) on the PATH; install gcc or clang, or set CC")
    result = subprocess.run([chosen, *arguments], capture_output=True, text=True, errors="replace")
    if result.returncode:
        complaint = next((line for line in result.stderr.splitlines() if "error" in line), result.stderr.strip())
        raise InputError(f"{chosen} could not compile the model: {complaint}; export it again, or name other flags")
