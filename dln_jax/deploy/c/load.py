"""Exported C as Python functions: compiled with the C compiler at hand, called through ctypes."""

import ctypes
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dln_jax.deploy.c.interface import read_interface
from dln_jax.deploy.c.text import PRECISIONS, check_name
from dln_jax.deploy.low_latency import as_shaped
from dln_jax.types import InputError

FLAGS = ("-O3", "-march=native")
"""Optimisation for the machine that compiles; sums are not reordered."""
WARNINGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror")


class CDynamics(NamedTuple):
    """Functions of one state, NumPy arrays [d] in and out, as those of `mechanics.dynamics.Dynamics`.

    Arguments of other shapes are refused with `InputError`. Each keeps buffers between calls: not for two threads at
    once, which load a copy each.
    """

    inverse_dynamics: Callable[[Any, Any, Any], np.ndarray]
    """(q, qd, qdd) -> tau [d]."""
    forward_dynamics: Callable[[Any, Any, Any], np.ndarray]
    """(q, qd, tau) -> qdd [d]."""
    energy: Callable[[Any, Any], Any]
    """(q, qd) -> T + V."""
    mass_matrix: Callable[..., Any]
    """(q, qd=None) -> M [d, d], by default at rest, qd = 0."""


class CPlainDynamics(NamedTuple):
    """The same of a model that comes from no energy."""

    inverse_dynamics: Callable[[Any, Any, Any], np.ndarray]
    forward_dynamics: Callable[[Any, Any, Any], np.ndarray]


class CFunction(NamedTuple):
    """A differential network, NumPy arrays in and out; shapes and threads as for `CDynamics`."""

    value: Callable[[Any], np.ndarray]
    """x [n] -> y [m]."""
    value_and_jacobian: Callable[[Any], tuple[np.ndarray, np.ndarray]]
    """x [n] -> y [m], dy/dx [m, n]."""


def load_c(
    directory: str | Path, *, name: str = "model", compiler: str | None = None, flags: Sequence[str] = FLAGS
) -> CDynamics | CPlainDynamics | CFunction:
    """Compiles an exported model in a temporary folder, and loads it.

    What is there is compiled and run: take a folder only from whom you trust. The digests in the description tell that
    a file was altered or does not belong to the others, not who wrote them.

    Args:
        directory: with the files that `export_c` wrote.
        name: of the model.
        compiler: by default $CC, cc, gcc or clang, whichever is there first.
        flags: for the compiler, beside those that make a C99 library without warnings.

    Raises:
        InputError: files are missing, altered or of another format, or there is no compiler, or it fails.
    """
    interface, sources = read_interface(Path(directory), check_name(name))
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
    numpy_type, declared = PRECISIONS[interface["precision"]][0], interface["functions"]
    functions = {key: getattr(library, f"{name}_{key}") for key in declared}
    if "d" not in interface:
        return _function(functions, interface["n"], interface["m"], numpy_type)
    return _dynamics(functions, interface["d"], numpy_type, " qd[" in declared.get("mass_matrix", ["", ""])[1])


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


def _dynamics(functions: dict[str, Any], d: int, numpy_type, with_velocity: bool) -> CDynamics | CPlainDynamics:
    inverse = _of_three(functions["inverse_dynamics"], ("q", "qd", "qdd"), d, numpy_type)
    forward = _of_three(functions["forward_dynamics"], ("q", "qd", "tau"), d, numpy_type)
    if "energy" not in functions:
        return CPlainDynamics(inverse, forward)
    # Buffers of their own, so that each function may have a thread of its own.
    (q_of_energy, qd_of_energy), (q_of_matrix, qd_of_matrix) = np.zeros((2, 2, d), numpy_type)
    matrix, shape = np.zeros((d, d), numpy_type), (d,)
    state = (q_of_matrix, qd_of_matrix)[: 1 + with_velocity]
    call_matrix = _bound(functions["mass_matrix"], *state, matrix)
    result = np.ctypeslib.as_ctypes_type(numpy_type)
    call_energy = _bound(functions["energy"], q_of_energy, qd_of_energy, result=result)

    def energy(q, qd):
        q_of_energy[:], qd_of_energy[:] = as_shaped("q", q, shape), as_shaped("qd", qd, shape)
        return call_energy()

    def mass_matrix(q, qd=None):
        q_of_matrix[:] = as_shaped("q", q, shape)
        qd_of_matrix[:] = 0 if qd is None else as_shaped("qd", qd, shape)
        call_matrix()
        return matrix.copy()

    return CDynamics(inverse, forward, energy, mass_matrix)


def _of_three(function, names: tuple[str, str, str], d: int, numpy_type) -> Callable[[Any, Any, Any], np.ndarray]:
    """The buffers' addresses are converted once, and a call copies 3 d numbers in and d out."""
    first, second, third, result = np.zeros((4, d), numpy_type)
    call, copy, shape = _bound(function, first, second, third, result), result.copy, (d,)

    def evaluate(q, qd, x):
        # Arrays of the right shape pass in a fraction of a microsecond; others go the long way.
        try:
            fits = q.shape == qd.shape == x.shape == shape
        except AttributeError:
            fits = False
        if not fits:
            q, qd, x = (as_shaped(*pair, shape) for pair in zip(names, (q, qd, x), strict=True))
        first[:], second[:], third[:] = q, qd, x
        call()
        return copy()

    return evaluate


def _function(functions: dict[str, Any], n: int, m: int, numpy_type) -> CFunction:
    point, y, jacobian = np.zeros(n, numpy_type), np.zeros(m, numpy_type), np.zeros((m, n), numpy_type)
    call, call_both = _bound(functions["value"], point, y), _bound(functions["value_and_jacobian"], point, y, jacobian)

    def value(x):
        point[:] = as_shaped("x", x, point.shape)
        call()
        return y.copy()

    def value_and_jacobian(x):
        point[:] = as_shaped("x", x, point.shape)
        call_both()
        return y.copy(), jacobian.copy()

    return CFunction(value, value_and_jacobian)


def _bound(function, *buffers: np.ndarray, result=None) -> Callable[[], Any]:
    """The C function with its arguments fixed; it must be called while the buffers live."""
    function.restype = result
    return functools.partial(function, *(ctypes.c_void_p(buffer.ctypes.data) for buffer in buffers))
