"""Conjugates in closed form against numerical ones, and policies against their slopes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from dln_jax.control.optimal.action_costs import (
    atan,
    bang_bang,
    bang_lin,
    centred,
    limited_atan,
    logistic,
    quadratic,
    scaled,
    shifted,
    tanh,
    weighted,
)
from dln_jax.types import InputError

HALF_TURN = np.pi / 2
COSTS = {  # cost, and its range
    "quadratic": (quadratic(0.7), -30, 30),
    "logistic": (logistic, 0, 1),
    "atan": (atan, -HALF_TURN, HALF_TURN),
    "tanh": (tanh, -1, 1),
    "bang-bang": (bang_bang, -1, 1),
    "bang-lin": (bang_lin, -1, 1),
    "limited atan": (limited_atan(2.5, 4.0), -2.5, 2.5),
    "scaled": (scaled(tanh, 5.5), -5.5, 5.5),
    "weighted": (weighted(logistic, 0.3), 0, 1),
    "shifted": (shifted(bang_lin, 0.4), -1.4, 0.6),
    "shifted, then scaled and weighted": (
        weighted(scaled(shifted(atan, -0.2), 3.0), 2.0),
        *(3 * (0.2 + HALF_TURN * np.array([-1, 1]))),
    ),
    "centred": (centred(scaled(tanh, 2.0), [1.2]), -2, 2),
}
W = (-6.0, -1.7, -0.3, 0.2, 0.9, 8.0)


@pytest.mark.parametrize("name", COSTS)
def test_the_conjugate_is_the_most_that_any_control_gains(name):
    cost, least, most = COSTS[name]
    conjugate, policy, of = (jax.jit(each) for each in (cost.conjugate, cost.policy, cost.cost))
    for w in W:
        loss = lambda u, w=w: float(of(jnp.array([u])) - w * u)  # noqa: E731
        found = minimize_scalar(loss, bounds=(least, most), method="bounded", options={"xatol": 1e-10})
        u = float(policy(jnp.array([w]))[0])
        assert conjugate(jnp.array([w])) == pytest.approx(-found.fun, rel=1e-6, abs=1e-6), w
        assert -loss(u) == pytest.approx(float(conjugate(jnp.array([w]))), rel=1e-12, abs=1e-12), w
        above, below = (conjugate(jnp.array([w + step])) for step in (1e-5, -1e-5))
        assert (above - below) / 2e-5 == pytest.approx(u, abs=1e-8), w


@pytest.mark.parametrize("name", COSTS)
def test_slopes_and_numbers_that_are_none(name):
    cost, least, most = COSTS[name]
    w = jnp.array([-2.0, 0.3, 5.0])
    np.testing.assert_allclose(jax.grad(cost.conjugate)(w), cost.policy(w), rtol=1e-12)
    assert np.isnan(cost.policy(w * jnp.nan)).all() and np.isnan(cost.conjugate(w * jnp.nan))
    if name != "quadratic":
        assert cost.cost(jnp.array([most + 0.1])) == np.inf == cost.cost(jnp.array([least - 0.1]))
    assert np.isnan(cost.cost(jnp.array([jnp.nan])))


def test_several_controls_and_a_matrix():
    R, w = np.array([[2.0, 0.5], [0.5, 1.0]]), jnp.array([0.3, -1.0])
    cost = quadratic(R)
    u = cost.policy(w)
    np.testing.assert_allclose(R @ u, w, rtol=1e-14)
    assert cost.conjugate(w) == pytest.approx(float(w @ u - cost.cost(u)))
    assert tanh.conjugate(w) == pytest.approx(sum(float(tanh.conjugate(w[i : i + 1])) for i in range(2)))


def test_the_curvature_of_the_limited_atan():
    found = jax.grad(jax.grad(lambda u: limited_atan(2.5, 4.0).cost(u[None])))(jnp.asarray(0.0))
    assert found == pytest.approx(np.pi * 4.0 / 5.0)


BAD = [
    (lambda: quadratic(-1.0), "not positive definite"),
    (lambda: quadratic([1.0, 2.0]), "symmetric matrix"),
    (lambda: scaled(tanh, 0.0), "a is 0.0"),
    (lambda: weighted(tanh, -1), "b is -1"),
    (lambda: centred(scaled(tanh, 2.0), [2.5]), "cannot hold the goal"),
    (lambda: limited_atan(np.nan, 1.0), "limit is nan"),
]


@pytest.mark.parametrize(("make", "message"), BAD)
def test_what_is_no_cost_is_one_line(make, message):
    with pytest.raises(InputError, match=message):
        make()
