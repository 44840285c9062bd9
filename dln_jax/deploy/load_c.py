"""Exported C as Python functions: compiled with the C compiler at hand, called through ctypes."""

import ctypes
import functools
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dln_jax.deploy.c_source import FORMAT
from dln_jax.deploy.c_text import PRECISIONS
from dln_jax.types import InputError

FLAGS = ("-O3", "-march=native")
"""Optimisation for the machine that compiles; sums are not reordered."""
WARNINGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror")


class CDynamics(NamedTuple):
    """Functions of one state, NumPy arrays [d] in and out, as those of `mechanics.dynamics.Dynamics`.

    Each keeps buffers between calls: not for two threads at once, which load a copy each.
    """

    inverse_dynamics: Callable[[Any, Any, Any], np.ndarray]
    """(q, qd, qdd) -> tau [d]."""
    forward_dynamics: Callable[[Any, Any, Any], np.ndarray]
    """(q, qd, tau) -> qdd [d]."""
    energy: Callable[[Any, Any], float] | None
    """(q, qd) -> T + V; `None` for a model that has none."""
    mass_matrix: Callable[..., np.ndarray] | None
    """(q, qd) -> M [d, d], or (q) where M depends on q alone; `None` as above."""


class CFunction(NamedTuple):
    """A differential network, NumPy arrays in and out; threads as for `CDynamics`."""

    value: Callable[[Any], np.ndarray]
    """x [n] -> y [m]."""
    value_and_jacobian: Callable[[Any], tuple[np.ndarray, np.ndarray]]
    """x [n] -> y [m], dy/dx [m, n]."""


def load_c(
    directory: str | Path, *, name: str = "model", compiler: str | None = None, flags: Sequence[str] = FLAGS
) -> CDynamics | CFunction:
    """Compiles an exported model into a temporary folder, and loads it.

    Args:
        directory: with the files that `export_c` wrote.
        name: of the model.
        compiler: by default $CC, cc, gcc or clang, whichever is there first.
        flags: for the compiler, beside those that make a C99 library without warnings.

    Raises:
        InputError: files are missing or of another format, or there is no compiler, or it fails.
    """
    directory = Path(directory)
    interface = _interface(directory, name)
    with tempfile.TemporaryDirectory() as folder:
        built = Path(folder) / f"lib{name}.so"
        arguments = [*WARNINGS, *flags, "-fPIC", "-shared", str(directory / f"{name}.c"), "-lm", "-o", str(built)]
        compile_c(arguments, compiler)
        # The functions take microseconds: handing the interpreter's lock to another thread and back would take longer.
        library = ctypes.PyDLL(str(built))
    numpy_type = PRECISIONS[interface["precision"]][0]
    functions = {key: getattr(library, f"{name}_{key}") for key in interface["functions"]}
    if "d" not in interface:
        return _function(functions, interface["n"], interface["m"], numpy_type)
    with_velocity = " qd[" in interface["functions"].get("mass_matrix", ["", ""])[1]
    return _dynamics(functions, interface["d"], numpy_type, with_velocity)


def compile_c(arguments: Sequence[str], compiler: str | None = None) -> None:
    """Runs a C compiler; InputError where there is none, or where it fails."""
    names = [compiler] if compiler else [os.environ.get("CC", "cc"), "cc", "gcc", "clang"]
    found = next((path for candidate in names if candidate and (path := shutil.which(candidate))), None)
    if found is None:
        raise InputError(f"no C compiler ({', '.join(names)}) on the PATH; install gcc or clang, or set CC")
    result = subprocess.run([found, *arguments], capture_output=True, text=True)
    if result.returncode:
        complaint = next((line for line in result.stderr.splitlines() if "error" in line), result.stderr.strip())
        raise InputError(f"{found} could not compile the model: {complaint}; export it again, or name other flags")


def _interface(directory: Path, name: str) -> dict[str, Any]:
    path = directory / f"{name}.json"
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the folder and the name of an exported model")
    try:
        interface = json.loads(path.read_text())
        found = interface["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: describes no exported model ({error}); export it again") from error
    if found != FORMAT:
        raise InputError(f"{path}: C format {found!r}; this release reads format {FORMAT}, so export it again")
    return interface


def _dynamics(functions: dict[str, Any], d: int, numpy_type, with_velocity: bool) -> CDynamics:
    has_energy = "energy" in functions
    return CDynamics(
        inverse_dynamics=_of_three(functions["inverse_dynamics"], d, numpy_type),
        forward_dynamics=_of_three(functions["forward_dynamics"], d, numpy_type),
        energy=_scalar(functions["energy"], d, numpy_type) if has_energy else None,
        mass_matrix=_matrix(functions["mass_matrix"], d, numpy_type, with_velocity) if has_energy else None,
    )


def _of_three(function, d: int, numpy_type) -> Callable[[Any, Any, Any], np.ndarray]:
    """The buffers' addresses are converted once, and a call copies 3 d numbers in and d out."""
    first, second, third, result = (np.zeros(d, numpy_type) for _ in range(4))
    call, copy = _bound(function, first, second, third, result), result.copy

    def evaluate(q, qd, x):
        first[:], second[:], third[:] = q, qd, x
        call()
        return copy()

    return evaluate


def _scalar(function, d: int, numpy_type) -> Callable[[Any, Any], float]:
    first, second = (np.zeros(d, numpy_type) for _ in range(2))
    result = ctypes.c_float if numpy_type is np.float32 else ctypes.c_double
    call = _bound(function, first, second, result=result)

    def evaluate(q, qd):
        first[:], second[:] = q, qd
        return call()

    return evaluate


def _matrix(function, d: int, numpy_type, with_velocity: bool) -> Callable[..., np.ndarray]:
    first, second, result = np.zeros(d, numpy_type), np.zeros(d, numpy_type), np.zeros((d, d), numpy_type)
    call = _bound(function, first, second, result) if with_velocity else _bound(function, first, result)

    def of_coordinates(q, qd=None):
        first[:] = q
        call()
        return result.copy()

    def of_state(q, qd):
        first[:], second[:] = q, qd
        call()
        return result.copy()

    return of_state if with_velocity else of_coordinates


def _function(functions: dict[str, Any], n: int, m: int, numpy_type) -> CFunction:
    point, y, jacobian = np.zeros(n, numpy_type), np.zeros(m, numpy_type), np.zeros((m, n), numpy_type)
    value, both = _bound(functions["value"], point, y), _bound(functions["value_and_jacobian"], point, y, jacobian)

    def evaluate(x):
        point[:] = x
        value()
        return y.copy()

    def evaluate_both(x):
        point[:] = x
        both()
        return y.copy(), jacobian.copy()

    return CFunction(evaluate, evaluate_both)


def _bound(function, *buffers: np.ndarray, result=None) -> Callable[[], Any]:
    """The C function with its arguments fixed; it must be called while the buffers live."""
    pointers = [ctypes.c_void_p(buffer.ctypes.data) for buffer in buffers]
    function.restype = result
    return functools.partial(function, *pointers)
