"""Conjugates in closed form against numerical ones, and policies against their slopes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose

from dln_jax.control.optimal.action_costs import centred, limited_atan, quadratic, stretched

COSTS = {  # cost, and its range
    "quadratic": (quadratic(0.7), -30, 30),
    "limited atan": (limited_atan(2.5, 4.0), -2.5, 2.5),
    "stretched": (stretched(limited_atan(2.5, 4.0), 0.4), -1, 1),
    "centred": (centred(limited_atan(2.0, 0.5), [1.2]), -2, 2),
}
W = np.array([-6.0, -1.7, -0.3, 0.2, 0.9, 8.0])


def test_conjugate_is_the_most_that_any_control_gains_and_the_policy_is_its_slope():
    for name, (cost, least, most) in COSTS.items():

        @jax.jit
        def known(w, u, cost=cost):
            """Conjugate, policy and slope of each w, and costs of controls [len(w), K]."""
            of_w = [jax.vmap(of)(w[:, None]) for of in (cost.conjugate, cost.policy, jax.grad(cost.conjugate))]
            return *of_w, jax.vmap(jax.vmap(lambda u: cost.cost(u[None])))(u)

        u = np.tile(np.linspace(least, most, 2001), (len(W), 1))
        for _ in range(4):  # finer around the best
            conjugate, policy, slope, costs = known(W, u)
            gains = W[:, None] * u - costs
            best = u[np.arange(len(W)), np.argmax(gains, axis=1)]
            u = best[:, None] + (u[:, 1:2] - u[:, :1]) * np.linspace(-1, 1, 2001)
        assert_allclose(conjugate, np.max(gains, axis=1), rtol=1e-6, atol=1e-6, err_msg=name)
        gained = W * policy[:, 0] - known(W, np.tile(policy, 2001))[3][:, 0]
        assert_allclose(gained, conjugate, rtol=1e-12, atol=1e-12, err_msg=name)
        assert_allclose(slope, policy, rtol=1e-12, err_msg=name)
        beyond = np.resize([least - 0.1, most + 0.1, np.nan], u.shape)
        conjugate, policy, _, costs = known(W * np.nan, beyond)
        assert np.isnan(conjugate).all() and np.isnan(policy).all() and np.isnan(costs[:, 2]).all(), name
        assert name == "quadratic" or (np.isinf(costs[:, 0]).all() and np.isinf(costs[:, 1]).all()), name


def test_several_controls_and_a_matrix():
    R, w = np.array([[2.0, 0.5], [0.5, 1.0]]), jnp.array([0.7, -40.0])
    assert_allclose(R @ quadratic(R).policy(w), w, rtol=1e-14)
    # Motors of different strength have a conjugate each.
    for cost in (quadratic(R), stretched(limited_atan(1.0, 3.0), [2.0, 0.1])):
        u = cost.policy(w)
        assert cost.cost(u) + cost.conjugate(w) == pytest.approx(float(w @ u), rel=1e-9)
    assert_allclose(jax.grad(cost.cost)(u), w, rtol=1e-6)


def test_the_curvature_of_the_limited_atan():
    found = jax.grad(jax.grad(lambda u: limited_atan(2.5, 4.0).cost(u[None])))(jnp.asarray(0.0))
    assert found == pytest.approx(np.pi * 4.0 / 5.0)


def test_numbers_that_make_no_cost_are_refused():
    for make, message in (
        (lambda: quadratic(-1.0), "not positive definite"),
        (lambda: quadratic([1.0, 2.0]), "symmetric matrix"),
        (lambda: stretched(limited_atan(1.0, 1.0), 0.0), "a is 0.0"),
        (lambda: limited_atan(1.0, -1), "weight is -1"),
        (lambda: centred(limited_atan(2.0, 1.0), [2.5]), "cannot hold the goal"),
        (lambda: limited_atan(np.nan, 1.0), "limit is nan"),
    ):
        with one_line(message):
            make()
