"""Results that overlap arguments, as state updates in place do."""

import ctypes

import jax.numpy as jnp
import numpy as np
from compilers import needs_compiler

from dln_jax.export.c.load import STANDARD, compile_c
from dln_jax.export.c.source import export_c

MOVES = {
    "shifted": lambda x: jnp.concatenate([x[:1] * 2, x[:-1]]),
    "rolled": lambda x: jnp.roll(x, 3),
    "transposed": lambda x: x.reshape(2, -1).T,
    "partly_computed": lambda x: jnp.concatenate([x[2:], jnp.sin(x[:2])]),
}
SIZES = (4, 12, 66)


@needs_compiler
def test_results_may_be_written_over_arguments(tmp_path):
    """Where the result is the argument, ahead of it or behind; and where two results exchange two arguments."""
    functions = {f"{name}_{n}": (move, (np.zeros(n),)) for name, move in MOVES.items() for n in SIZES}
    functions |= {f"swap_{n}": (lambda x, y: (y[::-1], 2 * x, x.sum() + y), (np.zeros(n),) * 2) for n in SIZES}
    export_c(functions, tmp_path, casadi=["swap_12"])
    assert "Results may overlap arguments, as updates in place do, but not" in (tmp_path / "model.h").read_text()
    sources, built = [str(tmp_path / f"model{part}.c") for part in ("", "_casadi")], str(tmp_path / "model.so")
    compile_c([*STANDARD, "-O3", "-fPIC", "-shared", *sources, "-lm", "-o", built])
    library = ctypes.CDLL(built)  # its pointers may be the same

    def pointer(array):
        return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))

    for n in SIZES:
        for name, move in MOVES.items():
            for written in (2, 3, 4):
                memory = np.random.default_rng(n).normal(size=n + 6)
                expected = np.ravel(move(memory[3 : 3 + n].copy()))
                library[f"model_{name}_{n}"](pointer(memory[3:]), pointer(memory[written:]))
                np.testing.assert_allclose(memory[written : written + n], expected, rtol=1e-14, err_msg=name)
        x, y, total = before = np.random.default_rng(0).normal(size=(3, n))
        before = before.copy()
        library[f"model_swap_{n}"](*map(pointer, (x, y, x, y, total)))
        np.testing.assert_allclose(
            (x, y, total), (before[1, ::-1], 2 * before[0], before[0].sum() + before[1]), atol=1e-13
        )
    x, y, total = before = np.random.default_rng(0).normal(size=(3, 12))
    before = before.copy()
    blocks = (ctypes.POINTER(ctypes.c_double) * 3)(*map(pointer, (x, y, total)))
    library.casadi_model_swap_12(blocks, blocks, None, None, 0)
    np.testing.assert_allclose((x, y), (before[1, ::-1], 2 * before[0]))
