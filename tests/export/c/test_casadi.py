"""Exported C through CasADi's `external`: values and derivatives equal JAX's, and its own generated C calls them.

A page of the documentation solves a swing-up with them, which runs in the tests too.
"""

import ctypes

import casadi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from comparison import STRICT, in_order
from compilers import needs_compiler

from dln_jax.export.c import casadi as external_c
from dln_jax.export.c.body import Source
from dln_jax.export.c.load import compile_c
from dln_jax.export.c.source import export_c
from dln_jax.export.functions import functions_of_system
from dln_jax.scenes.pendulums import pendulum

# A loop stacks a result of each turn, even if nothing reads it.
FLAGS = ("-std=c99", "-pedantic", *STRICT, "-Wno-unused-but-set-variable")
BOUND = 1e-12


def products(A, b, scale):
    return {"y": A @ b * scale, "Z": jnp.outer(b, jnp.sin(A[:, 0])) * scale}


def root(x):
    """Newton's method until it has converged; JAX has no reverse mode for it."""
    a = 2 + x @ x
    return jax.lax.while_loop(lambda r: jnp.any(jnp.abs(r * r - a) > 1e-9 * a), lambda r: (r + a / r) / 2, a)


FUNCTIONS = {
    "step": functions_of_system(pendulum().closed_form, 1, dtype=np.float64)["step_rk4"],
    "products": (products, [np.ones((3, 2)), np.ones(2), np.float64(1)]),
    "root": (root, [np.ones(3)]),
}


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("external")
    export_c(FUNCTIONS, folder, name="model", casadi=True)
    sources, built = [str(folder / f"model{part}.c") for part in ("", "_casadi")], folder / "libmodel.so"
    compile_c([*FLAGS, "-O1", "-fPIC", "-shared", *sources, "-lm", "-o", str(built)])
    return built


def of_a_vector(name):
    """The function of one vector, all arguments column-major and end to end, and the shapes of these."""
    function, examples = FUNCTIONS[name]
    shapes = [np.shape(example) for example in examples]
    cuts = np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1]

    def flat(x):
        arguments = [part.reshape(shape[::-1]).T for part, shape in zip(jnp.split(x, cuts), shapes, strict=True)]
        return jnp.concatenate([jnp.ravel(result.T) for result in jax.tree.leaves(in_order(function(*arguments)))])

    return flat, [(*shape, 1, 1)[:2] for shape in shapes]


@needs_compiler
@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_derivatives_equal_jax(name, library):
    flat, shapes = of_a_vector(name)
    function = casadi.external(f"casadi_model_{name}", str(library))
    symbols = [casadi.MX.sym(f"x{k}", *shape) for k, shape in enumerate(shapes)]
    results, variables = function(*symbols), casadi.veccat(*symbols)
    result = casadi.veccat(*results) if isinstance(results, list | tuple) else casadi.veccat(results)
    random = np.random.default_rng(0)
    x, weights, seed = (random.normal(size=n) for n in (variables.numel(), result.numel(), result.numel()))
    hessian, gradient = casadi.hessian(casadi.dot(result, weights), variables)
    backward = casadi.jtimes(result, variables, seed, True)
    along = casadi.jtimes(result, variables, x)
    every = casadi.Function(
        "every", symbols, [result, casadi.jacobian(result, variables), gradient, hessian, backward, along]
    )
    parts = np.split(x, np.cumsum([n * m for n, m in shapes])[:-1])
    got = every(*(part.reshape(shape, order="F") for part, shape in zip(parts, shapes, strict=True)))

    @jax.jit
    def derivatives(x):
        return flat(x), jax.jacfwd(flat)(x), jax.jacfwd(jax.jacfwd(lambda x: flat(x) @ weights))(x)

    value, slopes, curvature = derivatives(x)
    expected = value, slopes, weights @ slopes, curvature, seed @ slopes, slopes @ x
    assert np.abs(curvature).max() > 0
    for ours, wanted in zip(got, expected, strict=True):
        scale = max(1.0, np.abs(wanted).max())
        np.testing.assert_allclose(np.array(ours).reshape(wanted.shape), wanted, rtol=0, atol=BOUND * scale)


@needs_compiler
def test_null_pointers_are_zeros_and_what_nobody_wants(library):
    call = ctypes.CDLL(str(library)).jac_casadi_model_products
    Block = ctypes.POINTER(ctypes.c_double)
    A, written = np.arange(6.0), [np.full(36, np.nan) for _ in range(6)]
    arg = (Block * 5)(A.ctypes.data_as(Block))  # the others are null, and so is scale
    wanted = 2  # dy/dscale = A b, where b is zero
    res = (Block * 6)(*(array.ctypes.data_as(Block) if k == wanted else None for k, array in enumerate(written)))
    assert call(arg, res, None, None, 0) == 0
    assert np.array_equal(written[wanted][:3], np.zeros(3)) and np.isnan(written[wanted][3:]).all()
    assert np.isnan(written[:wanted]).all()


@needs_compiler
def test_c_that_casadi_generates_calls_the_library(library, tmp_path, monkeypatch):
    """As that of acados does, which links it."""
    step = casadi.external("casadi_model_step", str(library))
    x, u = casadi.MX.sym("x", 2), casadi.MX.sym("u")
    after = step(step(x, u, 0.1), u, 0.1)
    twice = casadi.Function("twice", [x, u], [after, casadi.jacobian(after, x), casadi.hessian(after[0], x)[0]])
    monkeypatch.chdir(tmp_path)
    twice.generate("twice.c")
    compile_c(["-O1", "-w", "-fPIC", "-shared", "twice.c", str(library), "-lm", "-o", "twice.so"])
    for ours, wanted in zip(casadi.external("twice", "./twice.so")([0.3, 1], 2), twice([0.3, 1], 2), strict=True):
        np.testing.assert_array_equal(np.array(ours), np.array(wanted))


REFUSED = {
    "three axes": (lambda x: x.sum(), [np.ones((2, 2, 2))], {}, "x is real of shape .2, 2, 2.; CasADi takes"),
    "a result of three axes": (lambda x: jnp.ones((1, 1, 1)) * x, [np.float64(1)], {}, "result is real of shape"),
    "integers": (lambda k: 2 * k, [np.int32(1)], {}, "k is int"),
    "empty": (lambda x: jnp.ones(2), [np.ones(0)], {}, "non-empty axes"),
    "no arguments": (lambda: jnp.ones(2), [], {}, "no arguments to differentiate"),
    "single precision": (lambda x: x, [np.ones(2)], {"precision": "f32"}, "CasADi computes in double"),
    "a name for itself": (lambda hess: hess, [np.ones(2)], {}, "CasADi does not accept the name hess"),
    "two underscores": (lambda x: x, [np.ones(2)], {"name": "my__arm"}, "my__arm_f"),
    "a name twice": (lambda a, out_a: {"y": a}, [np.ones(2)] * 2, {}, "the name out_a"),
}


def test_what_casadi_cannot_take_is_refused(tmp_path):
    for function, examples, keywords, message in REFUSED.values():
        with one_line(message):
            export_c({"f": (function, examples)}, tmp_path / "c", casadi=True, **keywords)
    assert not (tmp_path / "c").exists()
    with one_line(r"^casadi_m_f: it needs 4 KiB of stack; the limit is 2 KiB; export it without casadi$"):
        external_c.external_functions("m", {"f": (jnp.tanh, [np.ones(500)])}, Source("f64"), stack=2048)


def test_what_casadi_cannot_take_is_left_out_where_it_may_be(tmp_path):
    functions = {"f": (jnp.tanh, [np.ones(2)]), "g": (lambda x: x.sum(), [np.ones((2, 2, 2))]), "h": (jnp.cos, [1.0])}
    for chosen, missing in ((True, "gi"), (("f", "g"), "ghi")):
        folder = tmp_path / str(chosen)
        export_c(functions, folder, casadi=chosen, leave_out_large=True)
        text = (folder / "model_casadi.c").read_text()
        assert [letter for letter in "fghi" if f"DESCRIBED(casadi_model_{letter}," not in text] == list(missing)
        assert " * Left out: casadi_model_g: x is real of shape [2, 2, 2]; CasADi takes real" in text
        assert "model_g(" in (folder / "model.h").read_text()
