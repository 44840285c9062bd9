"""Results that overlap arguments, as state updates in place do."""

import ctypes
import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.export.c.load import STANDARD, compile_c
from dln_jax.export.c.source import export_c

needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler on the PATH"
)
MOVES = {
    "reversed": lambda x: x[::-1],
    "shifted": lambda x: jnp.concatenate([x[:1] * 2, x[:-1]]),
    "unchanged": lambda x: x,
    "rolled": lambda x: jnp.roll(x, 3),
    "transposed": lambda x: x.reshape(2, -1).T,
    "partly_computed": lambda x: jnp.concatenate([x[2:], jnp.sin(x[:2])]),
}
SIZES = (4, 12, 66)


def library(functions, folder, **options):
    """Loaded by ctypes, whose pointers may be the same."""
    export_c(functions, folder, **options)
    built = folder / "model.so"
    sources = [str(folder / "model.c")] + [str(folder / "model_casadi.c")] * ("casadi" in options)
    compile_c([*STANDARD, "-O3", "-fPIC", "-shared", *sources, "-lm", "-o", str(built)])
    return ctypes.CDLL(str(built))


def pointer(array, offset=0):
    return array[offset:].ctypes.data_as(ctypes.POINTER(ctypes.c_double))


@needs_compiler
def test_results_may_be_written_over_arguments(tmp_path):
    functions = {f"{name}_{n}": (move, (np.zeros(n),)) for name, move in MOVES.items() for n in SIZES}
    made = library(functions, tmp_path)
    for name, move in MOVES.items():
        for n in SIZES:
            # Where the result is the argument, and where it is ahead of it or behind.
            for taken, written in ((3, 3), (3, 4), (3, 2)):
                memory = np.random.default_rng(n).normal(size=n + 6)
                expected = np.asarray(move(memory[taken : taken + n].copy())).ravel()
                made[f"model_{name}_{n}"](pointer(memory, taken), pointer(memory, written))
                np.testing.assert_allclose(memory[written : written + n], expected, rtol=1e-14, err_msg=name)


@needs_compiler
@pytest.mark.parametrize("n", SIZES)
def test_two_results_may_exchange_two_arguments(n, tmp_path):
    made = library({"swap": (lambda x, y: (y, 2 * x, x.sum() + y), (np.zeros(n), np.zeros(n)))}, tmp_path)
    x, y, total = np.random.default_rng(0).normal(size=(3, n))
    before = x.copy(), y.copy()
    made.model_swap(pointer(x), pointer(y), pointer(x), pointer(y), pointer(total))
    np.testing.assert_array_equal(x, before[1])
    np.testing.assert_array_equal(y, 2 * before[0])
    np.testing.assert_allclose(total, before[0].sum() + before[1], atol=1e-13)


@needs_compiler
def test_functions_for_casadi_may_write_over_their_arguments(tmp_path):
    made = library({"swap": (lambda x, y: (y[::-1], x), (np.zeros(9), np.zeros(9)))}, tmp_path, casadi=True)
    x, y = np.random.default_rng(0).normal(size=(2, 9))
    before = x.copy(), y.copy()
    blocks = (ctypes.POINTER(ctypes.c_double) * 2)(pointer(x), pointer(y))
    made.casadi_model_swap(blocks, blocks, None, None, 0)
    np.testing.assert_array_equal(x, before[1][::-1])
    np.testing.assert_array_equal(y, before[0])


def test_header_says_what_may_overlap(tmp_path):
    export_c({"f": (jnp.sin, (np.zeros(3),))}, tmp_path)
    header = (tmp_path / "model.h").read_text()
    assert "Results may overlap arguments, as updates in place do, but not each other" in header
