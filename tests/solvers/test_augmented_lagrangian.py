"""Minima under inequalities, against closed forms and a published minimum."""

import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.solvers.augmented_lagrangian import make_minimiser


def rosenbrock(x):
    return (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2


PROBLEMS = {
    "nearest point of a half-plane": (lambda x: (x @ x, 1 - x[:1] - x[1:]), [2.0, 0.0], [0.5, 0.5]),
    "corner of a box": (lambda x: (-jnp.sum(x), jnp.concatenate([x - 1, -x])), [0.2, 0.7], [1.0, 1.0]),
    "valley cut by a disc": (lambda x: (rosenbrock(x), jnp.sum(x**2)[None] - 1), [0.0, 0.0], [0.786415, 0.617698]),
}


@pytest.mark.parametrize("function, start, expected", PROBLEMS.values(), ids=PROBLEMS)
def test_minima(function, start, expected):
    found = make_minimiser(function, rounds=20, tolerance=1e-7)(np.array(start))
    assert np.allclose(found.x, expected, atol=1e-4)
    assert found.violation <= 1e-5 and 1 <= found.rounds <= 20
    assert np.isclose(found.value, function(found.x)[0])


def test_arguments_are_handed_on():
    minimise = make_minimiser(lambda x, goal: (jnp.sum((x - goal) ** 2), x - 1))
    assert np.allclose(minimise(np.zeros(2), np.array([0.5, 3.0])).x, [0.5, 1.0], atol=1e-3)


def test_a_start_that_is_not_finite_is_refused():
    with one_line("not finite at the start"):
        make_minimiser(lambda x: (jnp.log(x[0]), x))(np.array([-1.0]))
    with one_line("rounds"):
        make_minimiser(lambda x: (x @ x, x), rounds=0)
