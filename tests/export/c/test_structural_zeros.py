"""Zeros and ones that a derivative's structure fixes cost nothing in C for finite arguments, and change no result."""

import json

import jax
import jax.numpy as jnp
import numpy as np
from comparison import files_of, in_c, in_jax
from compilers import needs_compiler
from jax import lax

from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.export.functions import functions_of_system
from dln_jax.scenes.pendulums import pendulum

BOUND = 1e-12
SPARSE = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 2.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 3.0, 0.0]])


def operations(function, *examples, finite=True):
    stated = json.loads(files_of({"f": (function, examples)}, finite=finite)["model.json"])
    return stated["functions"]["f"]["operations"]


def tangents_in_a_scan(x, u):
    """The last state has no influence, and the controls act on one state."""

    def body(carry, control):
        return jnp.stack([carry[1], carry[2] * carry[0] + control, 0.5 * carry[2]]), carry[0]

    return jax.jacfwd(lambda x, u: lax.scan(body, x, u), argnums=(0, 1))(x, u)


def powers_of_a_triangle(x):
    """The product stays triangular, with ones in its last row's corner; each step's matrix goes to another loop."""
    step = jnp.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).at[0, 1].set(x).at[1, 1].set(x)
    last, every = lax.scan(lambda m, _: (m @ step, m @ step), jnp.eye(3), length=4)
    return last, lax.scan(lambda v, m: (m.T @ v, v[1]), jnp.stack([x, x, x]), every)


def a_loop_after_a_loop_whose_output_is_moved(x):
    """Constants stand in some steps of the second loop's array, or differ from step to step, or are in all of them."""
    _, every = lax.scan(lambda v, _: (v * x, v), jnp.stack([x, x + 1, x - 1]), length=4)
    shifted = jnp.concatenate([every[:-1], jnp.zeros((1, 3))])
    numbered = jnp.concatenate([every[:, :2], jnp.arange(4.0)[:, None]], axis=1)
    masked = jnp.concatenate([every[:, :1], jnp.full((4, 1), 2.0), every[:, 2:]], axis=1)
    return [lax.scan(lambda v, y: (v * y + y[::-1], v), every[0], part) for part in (shifted, numbered, masked)]


def solved(q):
    def solve(q):
        m = jnp.array([[2.0 + q[0], 0.0, 0.0], [0.0, 3.0, q[1]], [0.0, q[1], 4.0]])
        return jnp.linalg.solve(m, jnp.eye(3)), jnp.linalg.cholesky(m), lax.cond(q[0] > 0, jnp.sin, jnp.cos, q)

    return jax.jacfwd(solve)(0.1 * q)


def branches(x):
    """Both branches, and what follows them, need the elements of one array: scalars of a branch are not read behind."""
    inside = lax.cond(x[0] > 0, lambda x: jnp.sin(2 * x), lambda x: -jnp.sin(2 * x), x)
    return inside + jnp.sin(2 * x), 2 * x


STEP = functions_of_system(pendulum().closed_form, 1, dtype=np.float64)["step_rk4_jacobian"]
PROGRAMS = {
    "tangents_in_a_scan": (tangents_in_a_scan, (np.zeros(3), np.zeros(4))),
    "powers_of_a_triangle": (powers_of_a_triangle, (np.zeros(()),)),
    "moved_output": (a_loop_after_a_loop_whose_output_is_moved, (np.zeros(()),)),
    "solved": (solved, (np.zeros(2),)),
    "branches": (branches, (np.zeros(3),)),
    "step_rk4_jacobian": STEP,
}


@needs_compiler
def test_dropping_zeros_changes_no_result(tmp_path):
    random = np.random.default_rng(0)
    states = {
        name: [tuple(random.normal(size=example.shape) for example in examples) for _ in range(4)]
        for name, (_, examples) in PROGRAMS.items()
    }
    ours, theirs = in_c(PROGRAMS, states, tmp_path, finite=True), in_jax(PROGRAMS, states)
    for name in PROGRAMS:
        for mine, of_jax in zip(ours[name], theirs[name], strict=True):
            np.testing.assert_allclose(mine, of_jax, atol=BOUND * max(1, np.abs(of_jax).max()), err_msg=name)


def test_operations_are_those_that_the_pattern_needs():
    """Each row of the sparse matrix has one element: a factor of one costs nothing, the others one product a column."""

    def step(x, u):
        return jnp.concatenate([x[:3] + 0.1 * x[3:], x[3:] + 0.1 * u])

    assert operations(jax.jacfwd(lambda x: x * x), np.zeros(12)) <= 2 * 12
    assert operations(lambda b: SPARSE @ b, np.zeros((4, 5))) <= 3 * 5
    assert operations(lambda b: SPARSE @ b, np.zeros((4, 5)), finite=False) >= 4 * 4 * 5
    assert operations(lambda x, u: jax.jacfwd(step, argnums=(0, 1))(x, u), np.zeros(6), np.zeros(3)) == 0
    function, examples = STEP
    assert operations(function, *examples) < 0.9 * operations(function, *examples, finite=False)


def test_what_a_loop_leaves_zero_costs_nothing_in_it_nor_in_the_loop_that_follows():
    """Per iteration of the first loop three products and an addition, of the second two products and an addition."""
    for finite, most in ((True, 4 * (3 + 1 + 2 + 1)), (False, np.inf)):
        spent = operations(powers_of_a_triangle, np.zeros(()), finite=finite)
        assert spent <= most and (finite or spent >= 4 * (27 + 15))


@needs_compiler
def test_nan_reaches_every_result_unless_arguments_are_finite(tmp_path):
    functions = {"product": (lambda x: SPARSE @ jnp.stack([x, x], 1), (np.zeros(4),))}
    x = np.array([np.nan, 1.0, 2.0, 3.0])
    for finite in (False, True):
        export_c(functions, tmp_path / str(finite), finite=finite)
        result = load_c(tmp_path / str(finite), flags=("-O1",)).product(x)
        assert np.isnan(result).all(1).tolist() == [not finite, not finite, True, not finite]
