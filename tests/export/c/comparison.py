"""Exported C beside the JAX functions that it is of: both called on the same states."""

import shutil
import subprocess
import tempfile

import jax
import numpy as np
import pytest

from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c

STRICT = ("-Wall", "-Wextra", "-Werror", "-Wconversion", "-Wshadow", "-Wdouble-promotion")
"""Warnings, which fail."""
BOUND = {"f64": 1e-12, "f32": 1e-5}
TYPES = {"f64": np.float64, "f32": np.float32}
needs_gcc = pytest.mark.skipif(
    not shutil.which("gcc") or "Free Software" not in subprocess.getoutput("gcc --version"), reason="there is no gcc"
)


def at_precision(tree, precision):
    """Real numbers of a tree as arrays of the precision; too large ones are infinite."""

    def cast(leaf):
        array = np.asarray(leaf)
        return array.astype(TYPES[precision]) if array.dtype.kind == "f" else array

    with np.errstate(over="ignore"):
        return jax.tree.map(cast, tree)


def in_c(functions, states, folder, *, precision="f64", flags=("-O1",), **options):
    """Leaves of the results of each function, [states, ...] each: exported at once, and compiled without a warning."""
    at = {name: (function, at_precision(examples, precision)) for name, (function, examples) in functions.items()}
    export_c(at, folder, precision=precision, **options)
    if precision == "f32":
        assert "double" not in (folder / "model.c").read_text()
    own = ["-DDLN_OWN_ELEMENTARY"] * (precision == "f64")  # the functions of the C library in f32
    loaded = load_c(folder, flags=(*flags, *own, *STRICT))
    results = {}
    for name in functions:
        call = getattr(loaded, name)
        columns = zip(*map(jax.tree.leaves, states[name]), strict=True)
        rows = [call(*state) for state in zip(*(at_precision(np.stack(c), precision) for c in columns), strict=True)]
        rows = [row if isinstance(row, tuple) else (row,) for row in rows]
        results[name] = [np.stack([np.asarray(result) for result in column]) for column in zip(*rows, strict=True)]
    return results


def files_of(functions, name="model", **options):
    """The contents of an export's files, by name."""
    with tempfile.TemporaryDirectory() as folder:
        return {path.name: path.read_bytes() for path in export_c(functions, folder, name=name, **options)}


def in_order(tree):
    """A result with dictionaries as tuples of their values: JAX would sort the keys, C has them as written."""
    return tuple(map(in_order, tree.values())) if isinstance(tree, dict) else tree


def in_jax(functions, states, *, precision="f64"):
    """The same results from JAX: the functions are compiled together and mapped over the states."""
    stacked = {
        name: at_precision(jax.tree.map(lambda *leaves: np.stack(leaves), *states[name]), precision)
        for name in functions
    }
    ordered = {name: lambda *state, f=function: in_order(f(*state)) for name, (function, _) in functions.items()}
    with jax.enable_x64(precision == "f64"):  # as they are exported
        every = jax.jit(lambda states: {name: jax.vmap(ordered[name])(*states[name]) for name in functions})(stacked)
    return {name: [np.asarray(leaf) for leaf in jax.tree.leaves(tree)] for name, tree in every.items()}
