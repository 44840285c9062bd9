"""Regulators against closed forms, against each other, and against the optimum of one dense quadratic problem."""

import jax
import numpy as np
import pytest

from dln_jax.control import lqr, sampled_lqr, time_varying_lqr
from dln_jax.control.regulators import held
from dln_jax.types import InputError

A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
Q, R = np.eye(2), np.eye(1)


def test_the_double_integrator_has_its_closed_form():
    found = lqr(A, B, Q, R)
    np.testing.assert_allclose(found.K, [[1.0, np.sqrt(3)]], rtol=1e-12)
    np.testing.assert_allclose(found.S, [[np.sqrt(3), 1.0], [1.0, np.sqrt(3)]], rtol=1e-12)


def test_sampling_faster_comes_to_continuous_time_at_first_order():
    exact = np.asarray(lqr(A, B, Q, R).S)
    errors = [np.abs(np.asarray(sampled_lqr(A, B, Q, R, dt).S) - exact).max() for dt in (0.02, 0.01, 0.005)]
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.1) and errors[1] / errors[2] == pytest.approx(2, rel=0.1)


def test_a_long_recursion_comes_to_the_constant_regulator():
    dt = 0.05
    F, G = held(A, B, dt)
    found = time_varying_lqr(np.tile(F, (400, 1, 1)), np.tile(G, (400, 1, 1)), dt * Q, dt * R, np.zeros((2, 2)))
    constant = sampled_lqr(A, B, Q, R, dt)
    np.testing.assert_allclose(found.K[0], constant.K, rtol=1e-10)
    np.testing.assert_allclose(found.S[0], constant.S, rtol=1e-10)


def test_the_recursion_is_the_optimum_of_all_controls_at_once():
    random, steps = np.random.default_rng(0), 6
    F, G = np.eye(3) + 0.3 * random.normal(size=(steps, 3, 3)), random.normal(size=(steps, 3, 2))
    end = 2 * np.eye(3)
    found = time_varying_lqr(F, G, np.eye(3), 0.5 * np.eye(2), end)
    x = start = np.array([1.0, -2.0, 0.5])
    controls = []
    for step in range(steps):
        controls.append(-np.asarray(found.K[step]) @ x)
        x = F[step] @ x + G[step] @ controls[-1]

    def cost(flat):
        x, total = start, 0.0
        for step, u in enumerate(flat.reshape(steps, 2)):
            total += x @ x + 0.5 * u @ u
            x = F[step] @ x + G[step] @ u
        return total + x @ end @ x

    flat = np.concatenate(controls)
    np.testing.assert_allclose(jax.grad(cost)(flat), 0.0, atol=1e-9)
    assert cost(flat) == pytest.approx(start @ np.asarray(found.S[0]) @ start, rel=1e-12)


BAD = [
    ((A, np.array([[1.0], [0.0]]), Q, R), "not controllable"),
    ((np.diag([1.0, -1.0]), np.array([[0.0], [1.0]]), Q, R), "not controllable"),
    ((A, B, np.eye(3), R), "Q has shape"),
    ((A, B, Q, -R), "positive definite"),
    ((A, B, -Q, R), "semi-definite"),
    ((A, B, np.zeros((2, 2)), R), "no stabilising solution|has no solution"),
    ((A * np.nan, B, Q, R), "A is not finite"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_what_has_no_regulator_is_one_line(arguments, message):
    with pytest.raises(InputError, match=message):
        lqr(*arguments)


def test_a_mode_that_decays_by_itself_needs_no_control():
    assert np.isfinite(lqr(np.diag([1.0, -1.0]), np.array([[1.0], [0.0]]), Q, R).K).all()
