"""Loads exported C as Python functions: compiles it with a local C compiler, together with a generated binding.

The binding is C code that calls the exported functions from Python. It declares the few Python functions (3.11 and
later) that it needs, so it needs no headers. The inverse dynamics of a two-link arm takes 0.5 us per call. With ctypes
it takes 8.5 us for arrays, or 1.1 us with prebound buffers for a single caller (the fastest of 81 turns of 5,000 calls
on two shared cores).
"""

import collections
import ctypes
import functools
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from dln_jax.export.c.interface import Function, Leaf, Signature, read_interface
from dln_jax.export.c.text import C_TYPES, NUMPY_TYPES, PRECISIONS, check_name
from dln_jax.mechanics.arguments import require_shape
from dln_jax.types import InputError

FLAGS = ("-O3", "-march=native", "-DDLN_OWN_ELEMENTARY")
"""Optimises for this processor, with vectorised elementary functions and without reordering sums."""
STANDARD = ("-std=c99", "-pedantic")
# On macOS the linker needs an option to resolve Python's symbols at load time.
_UNDEFINED = ("-undefined", "dynamic_lookup") if sys.platform == "darwin" else ()


def load_c(
    directory: str | Path, *, name: str = "model", compiler: str | None = None, flags: Sequence[str] = FLAGS
) -> Any:
    """Compiles an export in a temporary folder and returns a named tuple of its functions.

    The functions take NumPy arrays (or lists of numbers) by position. They return their result, or a named tuple of
    several results, and raise `InputError` for other shapes than the exported ones. Contiguous arrays of the exported
    type are fastest; other arguments are converted first.

    The C code is compiled and run, so load only folders that you trust. The digest in the description detects altered
    or mixed-up files, but does not prove their origin.

    Args:
        directory: folder with the files of `export_c`.
        compiler: C compiler; default: the first of $CC, cc, gcc and clang that exists.
        flags: additional compiler flags.

    Raises:
        InputError: files are missing, altered or of another format, or there is no working compiler.

    Example:
        >>> import numpy as np
        >>> import dln_jax
        >>> paths = dln_jax.export_c({"square": (lambda x: x**2, (np.ones(3),))}, "square-c")
        >>> dln_jax.load_c("square-c").square([1.0, 2.0, 3.0])
        array([1., 4., 9.])
    """
    precision, signatures, sources = read_interface(Path(directory), check_name(name))
    types = {**NUMPY_TYPES, "bool": np.int32, "real": PRECISIONS[precision][0]}
    try:
        with tempfile.TemporaryDirectory() as folder:
            # Compiles the checked bytes, even if the folder changes meanwhile.
            files = {f"{folder}/{file_name}": content for file_name, content in sources.items()}
            # No file of an export has a hyphen in its name.
            files[f"{folder}/for-python.c"] = _binding(name, signatures, PRECISIONS[precision][1], types).encode()
            for path, content in files.items():
                Path(path).write_bytes(content)
            texts = [path for path in files if path.endswith(".c")]
            built = f"{folder}/lib{name}.so"
            compile_c([*STANDARD, *flags, "-fPIC", "-shared", *_UNDEFINED, *texts, "-lm", "-o", built], compiler)
            # PyDLL keeps the interpreter's lock: releasing it would take some microseconds, longer than the functions.
            make = ctypes.PyDLL(built)[f"{name}_python"]
    except OSError as error:
        raise InputError(f"{directory}: cannot be built in a temporary folder ({error}); set TMPDIR") from error
    make.argtypes, make.restype = (ctypes.c_int, ctypes.py_object), ctypes.py_object
    made: dict[str, Function] = {}
    for number, (key, signature) in enumerate(signatures.items()):
        convert = functools.partial(_call_converted, made, key, signature.arguments, types)
        group = collections.namedtuple(f"{key}_results", [leaf.name for leaf in signature.results])
        made[key] = make(number, (convert, group, *(np.zeros(x.shape, types[x.kind]).copy for x in signature.written)))
    return collections.namedtuple("Functions", made)(**made)


def compile_c(arguments: Sequence[str], compiler: str | None = None) -> None:
    """Runs a C compiler; raises InputError if there is none or if it fails."""
    names = [compiler] if compiler else [os.environ.get("CC", "cc"), "cc", "gcc", "clang"]
    chosen = next((path for candidate in names if candidate and (path := shutil.which(candidate))), None)
    if chosen is None:
        raise InputError(f"no C compiler ({', '.join(names)}) on the PATH; install gcc or clang, or set CC")
    result = subprocess.run([chosen, *arguments], capture_output=True, text=True, errors="replace")
    if result.returncode:
        complaint = next((line for line in result.stderr.splitlines() if "error" in line), result.stderr.strip())
        raise InputError(f"{chosen} could not compile the model: {complaint}; export it again, or pass other flags")


def _call_converted(
    made: Mapping[str, Function],
    name: str,
    leaves: Sequence[Leaf],
    types: Mapping[str, Any],
    *arguments: Any,
) -> Any:
    """Converts arguments to contiguous arrays of the exported types, and passes them to a function in `made`."""
    if len(arguments) != len(leaves):
        raise InputError(f"{name} takes {', '.join(leaf.name for leaf in leaves)}; got {len(arguments)} arguments")
    arrays = []
    for leaf, argument in zip(leaves, arguments, strict=True):
        array = np.asarray(None)
        with suppress(ValueError, TypeError):
            array = np.asarray(argument)
        if array.dtype.kind not in ("fiub" if leaf.kind == "bool" else "fiu"):
            raise InputError(f"{leaf.name} has type {array.dtype}; expected real numbers of shape {leaf.shape}")
        require_shape(leaf.name, array.shape, leaf.shape)
        arrays.append(np.array(array, types[leaf.kind], order="C"))
    return made[name](*arrays)


_BINDING = Template("""\
#include <stddef.h>

#include "$name.h"

typedef $real real;
typedef struct _object PyObject;
typedef ptrdiff_t Py_ssize_t;
typedef struct {
    void *buf;
    PyObject *obj;
    Py_ssize_t len, itemsize;
    int readonly, ndim;
    char *format;
    Py_ssize_t *shape, *strides, *suboffsets;
    void *internal;
} Py_buffer;
typedef PyObject *method(PyObject *, PyObject *const *, Py_ssize_t);
typedef struct {
    const char *name;
    method *called;
    int flags;
    const char *text;
} PyMethodDef;
enum { CONTIGUOUS_WITH_FORMAT = 0x3C, WRITABLE = 1, FAST = 0x80, MAXIMUM = $maximum };

extern PyObject PyFloat_Type;
int PyObject_GetBuffer(PyObject *, Py_buffer *, int);
void PyBuffer_Release(Py_buffer *);
void PyErr_Clear(void);
PyObject *PyErr_Occurred(void);
void Py_DecRef(PyObject *);
void Py_IncRef(PyObject *);
double PyFloat_AsDouble(PyObject *);
PyObject *PyFloat_FromDouble(double);
PyObject *PyLong_FromLongLong(long long);
PyObject *PyLong_FromUnsignedLongLong(unsigned long long);
PyObject *PyCMethod_New(PyMethodDef *, PyObject *, PyObject *, PyObject *);
PyObject *PyObject_CallObject(PyObject *, PyObject *);
int PyObject_IsInstance(PyObject *, PyObject *);
PyObject *PyTuple_GetItem(PyObject *, Py_ssize_t);
PyObject *PyTuple_New(Py_ssize_t);
int PyTuple_SetItem(PyObject *, Py_ssize_t, PyObject *);
PyObject *PyObject_Vectorcall(PyObject *, PyObject *const *, size_t, PyObject *);

#define GIVES_real(x) PyFloat_FromDouble((double)x)
#define GIVES_bool(x) PyLong_FromLongLong(x)
#define GIVES_int(x) PyLong_FromLongLong(x)
#define GIVES_long(x) PyLong_FromLongLong(x)
#define GIVES_unsigned(x) PyLong_FromUnsignedLongLong(x)
#define GIVES_unsigned_long(x) PyLong_FromUnsignedLongLong(x)

typedef struct {
    char format;
    int axes;
    Py_ssize_t shape[64]; /* the most that NumPy has */
} leaf;
typedef struct {
    int arguments, results;
    PyObject *(*run)(void **); /* the number that is returned, or NULL where results are arrays */
    leaf leaves[MAXIMUM];
} function;

/* Whether an object is an array of this type and shape; if so, the caller releases its buffer */
static int fits(PyObject *item, Py_buffer *buffer, const leaf *expected, int flags)
{
    int axis = 0;
    if (PyObject_GetBuffer(item, buffer, flags)) {
        PyErr_Clear();
        return 0;
    }
    if (buffer->ndim == expected->axes && buffer->format[0] == expected->format && !buffer->format[1]) {
        while (axis < expected->axes && buffer->shape[axis] == expected->shape[axis]) ++axis;
        if (axis == expected->axes) return 1;
    }
    PyBuffer_Release(buffer);
    return 0;
}

/* Results for arguments; NULL without an error if an argument does not fit */
static PyObject *results_of(const function *f, PyObject *self, PyObject *const *arguments)
{
    Py_buffer buffers[MAXIMUM];
    void *memory[MAXIMUM];
    real numbers[MAXIMUM];
    PyObject *results = PyTuple_New(f->results), *result = NULL;
    int held[MAXIMUM], k = 0;
    for (; results && k < f->arguments + f->results; ++k) {
        const leaf *expected = &f->leaves[k];
        const int place = k - f->arguments;
        PyObject *item = place < 0 ? arguments[k] : PyObject_CallObject(PyTuple_GetItem(self, place + 2), NULL);
        if (!item) break;
        if (place >= 0) (void)PyTuple_SetItem(results, place, item);
        held[k] = expected->axes || expected->format != '$format' || !PyObject_IsInstance(item, &PyFloat_Type);
        if (held[k] && !fits(item, &buffers[k], expected, CONTIGUOUS_WITH_FORMAT | (place < 0 ? 0 : WRITABLE))) break;
        if (!held[k]) numbers[k] = (real)PyFloat_AsDouble(item);
        memory[k] = held[k] ? buffers[k].buf : &numbers[k];
    }
    if (k == f->arguments + f->results) {
        result = f->run(memory);
        if (!result && f->results == 1) Py_IncRef(result = PyTuple_GetItem(results, 0));
        else if (!result) result = PyObject_CallObject(PyTuple_GetItem(self, 1), results);
    }
    while (k-- > 0)
        if (held[k]) PyBuffer_Release(&buffers[k]);
    if (results) Py_DecRef(results);
    return result;
}

/* A call; `self` holds a function that converts arguments and calls again, the class of results, and functions that
   return new result arrays */
static PyObject *called(const function *f, PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    PyObject *result = count != f->arguments ? NULL : results_of(f, self, arguments);
    if (result || PyErr_Occurred()) return result;
    return PyObject_Vectorcall(PyTuple_GetItem(self, 0), arguments, (size_t)count, NULL);
}
$functions
static PyMethodDef methods[] = {
$methods};

PyObject *${name}_python(int k, PyObject *self);
PyObject *${name}_python(int k, PyObject *self)
{
    return PyCMethod_New(&methods[k], self, NULL, NULL);
}
""")
_FUNCTION = Template("""
static PyObject *run_$number(void **memory)
{
    $call
}

static PyObject *call_$number(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    static const function f = {$arguments, $results, run_$number, {$leaves}};
    return called(&f, self, arguments, count);
}
""")


def _binding(name: str, signatures: Mapping[str, Signature], real: str, types: Mapping[str, Any]) -> str:
    """Returns the source of the binding, to compile with the export."""
    functions = methods = ""
    maximum = 1
    for number, (key, signature) in enumerate(signatures.items()):
        leaves = [*signature.arguments, *signature.written]
        count = len(signature.arguments)
        maximum = max(maximum, len(leaves))
        passed = [
            f"memory[{k}]" if leaf.shape or k >= count else f"*(const {C_TYPES[leaf.kind]} *)memory[{k}]"
            for k, leaf in enumerate(leaves)
        ]
        call = f"{name}_{key}({', '.join(passed)})"
        if signature.returns:
            call = f"return GIVES_{signature.results[0].kind}({call});"
        else:
            call = f"{call};\n    return NULL;"
        described = [
            f"{{'{np.dtype(types[leaf.kind]).char}', {len(leaf.shape)}, {{{', '.join(map(str, leaf.shape or (0,)))}}}}}"
            for leaf in leaves
        ]
        functions += _FUNCTION.substitute(
            number=number, call=call, arguments=count, results=len(leaves) - count, leaves=", ".join(described)
        )
        takes, gives = (", ".join(leaf.described for leaf in part) for part in (signature.arguments, signature.results))
        methods += f'    {{"{key}", call_{number}, FAST, "{key}({takes}) -> {gives}"}},\n'
    return _BINDING.substitute(
        name=name, real=real, functions=functions, methods=methods, format=np.dtype(types["real"]).char,
        maximum=maximum,
    )  # fmt: skip
