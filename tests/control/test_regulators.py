"""Regulators against closed forms, against each other, and against the dense conditions of one quadratic program."""

import jax
import numpy as np
from calls import one_line

from dln_jax.control import lqr, sampled_lqr, time_varying_lqr
from dln_jax.control.regulators import held
from dln_jax.control.riccati import Horizon, least_cost

A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
Q, R = np.eye(2), np.eye(1)


def test_the_double_integrator_has_its_closed_form():
    found = lqr(A, B, Q, R)
    np.testing.assert_allclose(found.K, [[1.0, np.sqrt(3)]], rtol=1e-12)
    np.testing.assert_allclose(found.S, [[np.sqrt(3), 1.0], [1.0, np.sqrt(3)]], rtol=1e-12)


def test_sampling_faster_comes_to_continuous_time_at_first_order():
    exact = np.asarray(lqr(A, B, Q, R).S)
    errors = [np.abs(np.asarray(sampled_lqr(A, B, Q, R, dt).S) - exact).max() for dt in (0.02, 0.01, 0.005)]
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 2.0, rtol=0.1)


def test_a_long_recursion_comes_to_the_constant_regulator():
    dt = 0.05
    F, G = held(A, B, dt)
    found = time_varying_lqr(np.tile(F, (400, 1, 1)), np.tile(G, (400, 1, 1)), dt * Q, dt * R, np.zeros((2, 2)))
    constant = sampled_lqr(A, B, Q, R, dt)
    np.testing.assert_allclose(found.K[0], constant.K, rtol=1e-10)
    np.testing.assert_allclose(found.S[0], constant.S, rtol=1e-10)


def test_problems_without_a_regulator_are_refused():
    for arguments, message in (
        ((A, np.array([[1.0], [0.0]]), Q, R), "not controllable"),
        ((np.diag([1.0, -1.0]), B, Q, R), "not controllable"),
        ((A, B, np.eye(3), R), "Q has shape"),
        ((A, B, Q, -R), "positive definite"),
        ((A, B, -Q, R), "semi-definite"),
        ((A, B, np.zeros((2, 2)), R), "no stabilising solution|has no solution"),
        ((A * np.nan, B, Q, R), "A is not finite"),
    ):
        with one_line(message):
            lqr(*arguments)
    # A mode that decays by itself needs no control.
    assert np.isfinite(lqr(np.diag([1.0, -1.0]), np.array([[1.0], [0.0]]), Q, R).K).all()


N, n, m = 5, 3, 2
FREE = np.array([True, False, True])


def horizon(curvature=1.0):
    random = np.random.default_rng(0)
    roots = random.normal(size=(N, n + m, n + m))
    return Horizon(
        random.normal(size=(N, n, n + m)),
        random.normal(size=(N, n)),
        random.normal(size=(N, n + m)),
        curvature * roots @ roots.transpose(0, 2, 1),
        random.normal(size=n),
        curvature * np.eye(n),
    )


def dense(program, free):
    """Minimiser and multipliers of all stages at once, with unknowns x_0, u_0, x_1, ..."""
    size = N * (n + m) + n
    H, g, C, b = np.zeros((size, size)), np.zeros(size), np.zeros((N * n, size)), np.zeros(N * n)
    for k in range(N):
        at, row = slice(k * (n + m), (k + 1) * (n + m)), slice(k * n, (k + 1) * n)
        H[at, at], g[at], b[row] = program.curvatures[k], program.gradients[k], -program.missed[k]
        C[row, at] = program.slopes[k]
        C[row, (k + 1) * (n + m) : (k + 1) * (n + m) + n] = -np.eye(n)
    H[-n:, -n:], g[-n:] = program.end_curvature, program.end_gradient
    fixed = np.eye(size)[:n][~free]
    C, b = np.concatenate([C, fixed]), np.append(b, np.zeros(len(fixed)))
    both = np.linalg.solve(np.block([[H, C.T], [C, np.zeros((len(C), len(C)))]]), np.append(-g, b))
    stages = np.append(both[:size], np.zeros(m)).reshape(N + 1, n + m)
    return stages[:, :n], stages[:-1, n:], both[size : size + N * n].reshape(N, n)


def test_the_recursion_solves_the_dense_conditions():
    program = horizon()
    for free in (None, FREE):
        solution = jax.jit(lambda program, free=free: least_cost(program, free))(program)
        expected = dense(program, np.zeros(n, bool) if free is None else free)
        for value, known in zip((solution.dx, solution.du, solution.multipliers), expected, strict=True):
            np.testing.assert_allclose(value, known, rtol=1e-8, atol=1e-8)
        assert solution.convex and not least_cost(horizon(-1.0), free).convex


def test_a_regulator_that_varies_in_time_has_the_gains_of_the_recursion():
    slopes, end = horizon().slopes, 2 * np.eye(n)
    still = np.zeros((N, n)), np.zeros((N, n + m))
    weights = np.tile(np.diag([1.0] * n + [0.5] * m), (N, 1, 1))
    program = Horizon(slopes, *still, weights, np.zeros(n), end)
    found = time_varying_lqr(slopes[..., :n], slopes[..., n:], np.eye(n), 0.5 * np.eye(m), end)
    np.testing.assert_allclose(found.K, -least_cost(program).K, rtol=1e-10, atol=1e-12)
