"""Which functions of a source are one function, and what an export leaves behind in the process."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from comparison import files_of
from compilers import needs_compiler

from dln_jax.export.c import lowering
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.export.functions import functions_of_system
from dln_jax.scenes.pendulums import chain


@pytest.fixture(autouse=True)
def small_functions_are_called(monkeypatch):
    """Not inlined, as only large ones are otherwise."""
    monkeypatch.setattr(lowering, "_LARGE_CALL", 6)


def model(weights):
    """A jitted function, whose constants are in a jitted function inside of it."""

    @jax.jit
    def layer(x):
        return jnp.tanh(weights @ x)

    @jax.jit
    def deep(x):
        return layer(layer(x) + 0.1 * x) - x

    return deep


W = np.random.default_rng(0).normal(size=(3, 3)) / 3
STATE = np.array([0.3, -0.2, 0.5])


def of_two(f, g):
    return lambda x: (f(x), g(x), f(2 * x), g(2 * x))


def parts(files):
    return files["model.c"].decode().count("static void part_")


@needs_compiler
def test_models_in_one_export_keep_their_own_weights(tmp_path):
    """Before and after training, and as members of an ensemble."""
    old, retrained = model(W), model(1.1 * W)
    functions = {"old": lambda x: old(old(x)), "retrained": lambda x: retrained(retrained(x))}
    functions["both"] = of_two(old, retrained)
    export_c({name: (function, (STATE,)) for name, function in functions.items()}, tmp_path)
    loaded = load_c(tmp_path, flags=("-O1",))
    for name, function in functions.items():
        np.testing.assert_allclose(getattr(loaded, name)(STATE), function(STATE), rtol=1e-12)


def test_what_is_called_counts_with_what_calls_it():
    """Functions that call another, or one that calls it, need its stack; each is written once."""
    inner = model(W)
    outer = jax.jit(lambda x: inner(x) + inner(inner(x)))
    callers = {
        "alone": lambda x: inner(x),
        "once": lambda x: inner(inner(x)),
        "of_outer": lambda x: 2 * outer(outer(x)),
        "of_both": lambda x: outer(outer(x)) + inner(x),
    }
    files = files_of({name: (call, (STATE,)) for name, call in callers.items()})
    stated = json.loads(files["model.json"])["functions"].values()
    operations, stack = ([facts[key] for facts in stated] for key in ("operations", "stack_bytes"))
    inside = operations[0]
    assert operations == [inside, 2 * inside, 4 * inside + 9, 5 * inside + 9]
    assert stack[0] < stack[1] < stack[2] - 512 and parts(files) == 2


def test_what_is_left_out_leaves_nothing_behind():
    """Neither tables nor functions that only it would have called."""
    large = np.random.default_rng(0).normal(size=(200, 200))
    small = {"f": (lambda x: 2 * x, (STATE,))}
    both = {"large": (lambda x: jnp.linalg.solve(large * x, large), (np.ones(()),)), **small}
    kept = files_of(both, leave_out_large=True)["model.c"]
    assert kept == files_of(small)["model.c"]


def test_precisions_may_follow_each_other_in_a_process(tmp_path):
    scene, q = chain(3), np.array([0.3, -0.4, 0.5])
    before = jax.jit(scene.gravity)(q)
    texts = []
    for turn, (precision, dtype) in enumerate(2 * [("f64", np.float64), ("f32", np.float32)]):
        functions = functions_of_system(scene.closed_form, 3, dtype=dtype)
        chosen = {"gravity_jacobian": functions["gravity_jacobian"]}
        texts.append(files_of(chosen, precision=precision))
        np.testing.assert_array_equal(jax.jit(scene.gravity)(q), before, err_msg=str(turn))
    assert texts[:2] == texts[2:]
    with jax.enable_x64(False):
        again = files_of(chosen, precision="f64")["model.c"]
    assert again == texts[0]["model.c"]  # constants are not rounded
