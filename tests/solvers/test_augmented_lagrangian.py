"""Minima under inequalities, against closed forms and SciPy's SLSQP."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from dln_jax.solvers.augmented_lagrangian import make_minimiser
from dln_jax.types import InputError


def rosenbrock(x):
    return (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2


PROBLEMS = {
    "nearest point of a half-plane": (lambda x: (x @ x, 1 - x[:1] - x[1:]), [2.0, 0.0], [0.5, 0.5]),
    "nothing is active": (lambda x: (jnp.sum((x - 1) ** 2), x - 5), [4.0, 0.0], [1.0, 1.0]),
    "corner of a box": (lambda x: (-jnp.sum(x), jnp.concatenate([x - 1, -x])), [0.2, 0.7], [1.0, 1.0]),
    "valley cut by a disc": (lambda x: (rosenbrock(x), jnp.sum(x**2)[None] - 1), [0.0, 0.0], None),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_minima(name):
    function, start, expected = PROBLEMS[name]
    if expected is None:
        disc = {"type": "ineq", "fun": lambda x: -np.asarray(function(x)[1])}
        expected = minimize(lambda x: float(function(x)[0]), start, constraints=[disc], tol=1e-12).x
    found = make_minimiser(function, rounds=20, tolerance=1e-7)(np.array(start))
    assert np.allclose(found.x, expected, atol=1e-4)
    assert found.violation <= 1e-5 and 1 <= found.rounds <= 20
    assert np.isclose(found.value, function(found.x)[0])


def test_arguments_are_handed_on():
    minimise = make_minimiser(lambda x, goal: (jnp.sum((x - goal) ** 2), x - 1))
    assert np.allclose(minimise(np.zeros(2), np.array([0.5, 3.0])).x, [0.5, 1.0], atol=1e-3)


def test_a_start_that_is_not_finite_is_refused():
    with pytest.raises(InputError, match="not finite at the start"):
        make_minimiser(lambda x: (jnp.log(x[0]), x))(np.array([-1.0]))
    with pytest.raises(InputError, match="rounds"):
        make_minimiser(lambda x: (x @ x, x), rounds=0)
