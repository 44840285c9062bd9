"""Loads exported C as Python functions: compiles it with a local C compiler, together with a generated binding."""

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

FLAGS = ("-O3", "-march=native", "-DDLN_OWN_ELEMENTARY")
"""Optimises for the compiling processor, with vectorised elementary functions, without reordering sums."""
STANDARD = ("-std=c99", "-pedantic")
# On macOS the linker must be told that Python's symbols resolve when the library is loaded.
_UNDEFINED = ("-undefined", "dynamic_lookup") if sys.platform == "darwin" else ()


def load_c(
    directory: str | Path, *, name: str = "model", compiler: str | None = None, flags: Sequence[str] = FLAGS
) -> Any:
    """Compiles an export in a temporary folder and returns a named tuple of its functions.

    The functions take NumPy arrays (or lists of numbers) by position or name, raise `InputError` for shapes that differ
    from the exported ones, and return their result, or a named tuple of several. Contiguous arrays of the exported type
    passed by position are fastest; other arguments are converted first.

    The C code is compiled and run, so load only folders that you trust. The digests in the description detect altered
    or mixed-up files; they do not prove who wrote them.

    Args:
        directory: folder with the files that `export_c` wrote.
        compiler: C compiler; default: the first of $CC, cc, gcc and clang that exists.
        flags: additional compiler flags.

    Raises:
        InputError: files are missing, altered or of another format, there is no compiler, or it fails.
    """
    precision, signatures, sources = read_interface(Path(directory), check_name(name))
    try:
        with tempfile.TemporaryDirectory() as folder:
            # The checked bytes are compiled, even if the folder changes meanwhile.
            for file_name, content in sources.items():
                (Path(folder) / file_name).write_bytes(content)
            # No file of an export has a hyphen in its name.
            between, built = Path(folder) / "for-python.c", Path(folder) / f"lib{name}.so"
            between.write_text(binding(name, signatures, precision))
            texts = [str(Path(folder) / f"{name}.c"), str(between)]
            compile_c([*STANDARD, *flags, "-fPIC", "-shared", *_UNDEFINED, *texts, "-lm", "-o", str(built)], compiler)
            # PyDLL keeps the interpreter's lock: releasing it takes longer than the functions, some microseconds.
            library = ctypes.PyDLL(str(built))
    except OSError as error:
        raise InputError(f"{directory}: not to be built in a temporary folder ({error}); set TMPDIR") from error
    return bound(library, name, signatures, precision)


def compile_c(arguments: Sequence[str], compiler: str | None = None) -> None:
    """Runs a C compiler; raises InputError if there is none or if it fails."""
    names = [compiler] if compiler else [os.environ.get("CC", "cc"), "cc", "gcc", "clang"]
    chosen = next((path for candidate in names if candidate and (path := shutil.which(candidate))), None)
    if chosen is None:
        raise InputError(f"no C compiler ({', '.join(names)}) on the PATH; install gcc or clang, or set CC")
    result = subprocess.run([chosen, *arguments], capture_output=True, text=True, errors="replace")
    if result.returncode:
        complaint = next((line for line in result.stderr.splitlines() if "error" in line), result.stderr.strip())
        raise InputError(f"{chosen} could not compile the model: {complaint}; export it again, or name other flags")
