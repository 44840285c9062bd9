"""A generated C source that makes exported functions callable from Python.

It replaces ctypes, whose calls take longer than the dynamics of a small arm. It declares the few Python functions that
it calls (Python 3.11 and later), so no Python headers are needed.
"""

import collections
import ctypes
import inspect
from collections.abc import Callable, Mapping
from string import Template
from typing import Any

import numpy as np

from dln_jax.export.c.interface import KINDS, Leaf, Signature
from dln_jax.export.c.text import NUMPY_TYPES, PRECISIONS
from dln_jax.mechanics.arguments import require_shape
from dln_jax.types import InputError

_GIVES = {"real": "PyFloat_FromDouble((double){})", "unsigned_long": "PyLong_FromUnsignedLongLong({})"}
_START = Template("""\
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
typedef PyObject *method(PyObject *, PyObject *const *, Py_ssize_t, PyObject *);
typedef struct {
    const char *name;
    method *called;
    int flags;
    const char *text;
} PyMethodDef;
enum { CONTIGUOUS_WITH_FORMAT = 0x3C, WRITABLE = 1, FAST_WITH_KEYWORDS = 0x82, MAXIMUM = $maximum };

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

typedef struct {
    char format;
    int axes;
    Py_ssize_t shape[$axes];
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
static PyObject *called(
    const function *f, PyObject *self, PyObject *const *arguments, Py_ssize_t count, PyObject *names)
{
    PyObject *result = names || count != f->arguments ? NULL : results_of(f, self, arguments);
    if (result || PyErr_Occurred()) return result;
    return PyObject_Vectorcall(PyTuple_GetItem(self, 0), arguments, (size_t)count, names);
}
""")


def binding(name: str, functions: Mapping[str, Signature], precision: str) -> str:
    """Returns the source of the binding, which is compiled together with the export."""
    leaves = [leaf for function in functions.values() for leaf in (*function.arguments, *function.results)]
    text = _START.substitute(
        name=name,
        real=PRECISIONS[precision][1],
        format=_format("real", precision),
        axes=max([1, *(len(leaf.shape) for leaf in leaves)]),
        maximum=max(1, *(len(function.arguments) + len(function.results) for function in functions.values())),
    )
    for number, (key, signature) in enumerate(functions.items()):
        text += _function(number, f"{name}_{key}", signature, precision)
    methods = "".join(
        f'    {{"{key}", call_{number}, FAST_WITH_KEYWORDS, "{_described(key, signature)}"}},\n'
        for number, (key, signature) in enumerate(functions.items())
    )
    made = f"PyObject *{name}_python(int k, PyObject *self)"
    returned = "return PyCMethod_New(&methods[k], self, NULL, NULL);"
    return f"{text}\nstatic PyMethodDef methods[] = {{\n{methods}}};\n\n{made};\n{made}\n{{\n    {returned}\n}}\n"


def bound(library: ctypes.PyDLL, name: str, functions: Mapping[str, Signature], precision: str) -> Any:
    """Returns a named tuple of the functions in a library that was built with the binding."""
    make = library[f"{name}_python"]
    make.argtypes, make.restype = (ctypes.c_int, ctypes.py_object), ctypes.py_object
    made: dict[str, Callable[..., Any]] = {}
    for number, (key, signature) in enumerate(functions.items()):
        group = collections.namedtuple(f"{key}_results", [leaf.name for leaf in signature.results])
        results = () if signature.returns else signature.results
        arrays = (np.zeros(leaf.shape, _type(leaf.kind, precision)) for leaf in results)
        converting = _converting(key, signature.arguments, precision, made)
        made[key] = make(number, (converting, group, *(array.copy for array in arrays)))
    return collections.namedtuple("Functions", made)(**made)


def _converting(
    name: str, leaves: tuple[Leaf, ...], precision: str, made: Mapping[str, Callable[..., Any]]
) -> Callable[..., Any]:
    """Returns a function that converts arguments to arrays and passes them to a function in `made`."""
    parameters = [inspect.Parameter(leaf.name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for leaf in leaves]
    expected = inspect.Signature(parameters)

    def converting(*arguments: Any, **keywords: Any) -> Any:
        try:
            values = expected.bind(*arguments, **keywords).args
        except TypeError as error:
            raise InputError(f"{name} takes {', '.join(leaf.name for leaf in leaves)}; {error}") from error
        arrays = (_array(leaf, value, precision) for leaf, value in zip(leaves, values, strict=True))
        return made[name](*arrays)

    return converting


def _array(leaf: Leaf, argument: Any, precision: str) -> np.ndarray:
    """Returns the argument as a contiguous array of the leaf's shape and type; `InputError` if it has another shape."""
    try:
        array = np.asarray(argument)
    except (ValueError, TypeError):
        raise InputError(f"{leaf.name} is not an array; expected real numbers of shape {leaf.shape}") from None
    if array.dtype.kind not in ("fiub" if leaf.kind == "bool" else "fiu"):
        raise InputError(f"{leaf.name} has type {array.dtype}; expected real numbers of shape {leaf.shape}")
    require_shape(leaf.name, array.shape, leaf.shape)
    return np.array(array, _type(leaf.kind, precision), order="C")


def _type(kind: str, precision: str) -> Any:
    return {**NUMPY_TYPES, "bool": np.int32, "real": PRECISIONS[precision][0]}[kind]


def _format(kind: str, precision: str) -> str:
    """Returns the format character of an array's buffer."""
    return np.zeros(1, _type(kind, precision)).data.format


_FUNCTION = Template("""
static PyObject *run_$number(void **memory)
{
    $call
}

static PyObject *call_$number(PyObject *self, PyObject *const *arguments, Py_ssize_t count, PyObject *names)
{
    static const function f = {$arguments, $results, run_$number, {$leaves}};
    return called(&f, self, arguments, count, names);
}
""")


def _function(number: int, name: str, signature: Signature, precision: str) -> str:
    """Returns two C functions: one passes pointers to an exported function, the other is called by Python."""
    results = () if signature.returns else signature.results
    leaves = [*signature.arguments, *results]
    passed = [
        f"memory[{k}]" if leaf.shape or k >= len(signature.arguments) else f"*(const {KINDS[leaf.kind]} *)memory[{k}]"
        for k, leaf in enumerate(leaves)
    ]
    call = f"{name}({', '.join(passed)})"
    if signature.returns:
        call = f"return {_GIVES.get(signature.results[0].kind, 'PyLong_FromLongLong({})').format(call)};"
    else:
        call = f"{call};\n    return NULL;"
    described = ", ".join(
        f"{{'{_format(leaf.kind, precision)}', {len(leaf.shape)}, {{{', '.join(map(str, leaf.shape or (0,)))}}}}}"
        for leaf in leaves
    )
    return _FUNCTION.substitute(
        number=number, call=call, arguments=len(signature.arguments), results=len(results), leaves=described
    )


def _described(key: str, signature: Signature) -> str:
    arguments, results = (
        ", ".join(f"{leaf.name} {list(leaf.shape)}" if leaf.shape else leaf.name for leaf in leaves)
        for leaves in (signature.arguments, signature.results)
    )
    return f"{key}({arguments}) -> {results}"
