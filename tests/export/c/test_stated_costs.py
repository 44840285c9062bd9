"""The stated cost of exported C: operations by kind at most, and a stack that gcc's own report stays within."""

import re
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from comparison import needs_gcc
from compilers import needs_compiler
from conftest import slow_among
from jax import lax

from dln_jax.export.c.interface import stated_costs
from dln_jax.export.c.load import FLAGS, STANDARD, load_c
from dln_jax.export.c.source import export_c
from dln_jax.export.functions import functions_of_system
from dln_jax.scenes.pendulums import cart_pole, chain

LEVELS = {False: (("-O1",), ("-Os",)), True: (("-O2",), FLAGS)}
"""Flags of a compiler, by whether arguments are stated finite."""
W = [np.random.default_rng(k).normal(size=shape) for k, shape in enumerate([(3, 40), (40, 40), (40, 10)])]


def cost_of(function, *examples, folder, **options):
    export_c({"f": (function, examples)}, folder, overwrite=True, **options)
    return stated_costs(folder)["f"]


def until(limit):
    """Newton's method for a square root; its condition compares a counter with the limit, if any."""

    def function(x):
        def unfinished(state):
            moving = jnp.abs(state[0] ** 2 - x) > 1e-12
            return moving if limit is None else moving & (state[1] < limit)

        return lax.while_loop(unfinished, lambda s: ((s[0] + x / s[0]) / 2, s[1] + 1), (x, 0))[0]

    return function


def test_operations_are_stated_by_kind_and_loops_count_every_iteration(tmp_path):
    cost = cost_of(lambda x, y: jnp.sqrt(x @ y) / (x[0] - jnp.sin(y[1])), np.zeros(3), np.zeros(3), folder=tmp_path)
    assert cost[1:6] == (3, 3, 1, 1, 1) and cost.unbounded_loops == 0
    header = (tmp_path / "model.h").read_text()
    assert "(additions 3, multiplications 3, divisions 1, square roots 1, functions 1)" in header
    assert f"at most {cost.operations} floating-point operations, {cost.stack_bytes} bytes of stack" in header
    cost = cost_of(lambda a, x: a @ x, np.zeros((40, 70)), np.zeros(70), folder=tmp_path)
    assert cost.operations == 2 * 40 * 70 and cost.stack_bytes < 8 * (2 * 40 + 1) + 1600
    number = np.zeros(())
    assert cost_of(lambda x: lax.fori_loop(0, 10, lambda k, y: y * x, x), number, folder=tmp_path).multiplications == 10
    # The cost of a branch is that of its most expensive case.
    cost = cost_of(lambda x: lax.cond(x > 0, lambda: x * x * x, lambda: x + 1), number, folder=tmp_path)
    assert (cost.multiplications, cost.additions) == (2, 0)
    # The counter in the condition bounds a loop.
    cost = cost_of(until(20), number, folder=tmp_path)
    assert cost.unbounded_loops == 0 and cost.divisions == 2 * 20
    assert cost_of(until(None), number, folder=tmp_path).unbounded_loops == 1
    assert "unbounded loops, with one iteration counted 1" in (tmp_path / "model.h").read_text()


@needs_compiler
def test_a_stated_bound_ends_a_loop_with_nan(tmp_path):
    for bound, root in ((3, np.nan), (40, 30.0)):
        cost = cost_of(until(None), np.zeros(()), folder=tmp_path, loop_bound=bound)
        assert cost.unbounded_loops == 0 and cost.divisions == 2 * bound
        np.testing.assert_allclose(load_c(tmp_path, flags=("-O1",)).f(900.0), root)


def stack_of(graph, function):
    """Largest sum of frames along calls from a function, in gcc's call graph."""
    frames = {
        title: int(size) for title, size in re.findall(r'node: { title: "([^"]*)" label: "[^"]*?(\d+) bytes', graph)
    }
    calls = re.findall(r'edge: { sourcename: "([^"]*)" targetname: "([^"]*)"', graph)

    def depth(title):
        return frames.get(title, 0) + max((depth(to) for at, to in calls if at == title), default=0)

    return depth(function)


def network(x):
    layers = jnp.tanh(jnp.sin(jnp.tanh(x @ W[0]) @ W[1]) @ W[2])
    return layers, jnp.sort(layers), jnp.linalg.eigh(jnp.outer(layers, layers))[0]


STACKS = {
    "implicit": functions_of_system(cart_pole().closed_form, 2, dtype=np.float64)["step_implicit_midpoint_jacobian"],
    "chain": functions_of_system(chain(3).closed_form, 3, dtype=np.float64)["forward_dynamics_jacobian"],
    "network": (lambda x: (network(x), jax.jacfwd(lambda x: network(x)[0])(x)), (np.zeros(3),)),
    "scan": (lambda x: lax.scan(lambda c, w: (jnp.tanh(c @ w), c), x, np.ones((50, 20, 20)))[1], (np.zeros(20),)),
    "solve": (lambda a: (jnp.linalg.solve(a @ a.T + jnp.eye(9), a), jnp.linalg.qr(a)), (np.zeros((9, 9)),)),
    "root": (until(20), (np.zeros(()),)),
}


@needs_gcc
@pytest.mark.parametrize("finite", slow_among(LEVELS, bool))
def test_no_function_takes_more_stack_than_it_states(finite, tmp_path):
    export_c(STACKS, tmp_path, finite=finite)
    for flags in LEVELS[finite]:
        command = ["gcc", *STANDARD, *flags, "-fstack-usage", "-fcallgraph-info=su", "-c", "model.c", "-o", "model.o"]
        subprocess.run(command, cwd=tmp_path, check=True)
        graph = (tmp_path / "model.ci").read_text()
        for name, cost in stated_costs(tmp_path).items():
            used = stack_of(graph, f"model_{name}")
            assert 0 < used <= cost.stack_bytes, (name, flags)
            assert cost.stack_bytes < 8 * used + 1024, (name, flags)
