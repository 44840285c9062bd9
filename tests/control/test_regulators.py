"""Regulators against closed forms, against each other, and against the conditions of a quadratic program."""

import jax
import jax.numpy as jnp
import numpy as np
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax.control.regulators import held, lqr, sampled_lqr, time_varying_lqr
from dln_jax.control.riccati import Horizon, least_cost

A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
Q, R = np.eye(2), np.eye(1)


def test_the_double_integrator_has_its_closed_form():
    found = lqr(A, B, Q, R)
    assert_allclose(found.K, [[1.0, np.sqrt(3)]], rtol=1e-12)
    assert_allclose(found.S, [[np.sqrt(3), 1.0], [1.0, np.sqrt(3)]], rtol=1e-12)


def test_a_long_recursion_comes_to_the_constant_regulator_and_fast_sampling_to_continuous_time():
    dt = 0.05
    F, G = held(A, B, dt)
    found = time_varying_lqr(np.tile(F, (400, 1, 1)), np.tile(G, (400, 1, 1)), dt * Q, dt * R, np.zeros((2, 2)))
    constant = sampled_lqr(A, B, Q, R, dt)
    assert_allclose(found.K[0], constant.K, rtol=1e-10)
    assert_allclose(found.S[0], constant.S, rtol=1e-10)
    assert_allclose(sampled_lqr(A, B, Q, R, 1e-4).S, lqr(A, B, Q, R).S, rtol=1e-3)


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


def lagrangian(program, dx, du, multipliers):
    """Cost of the steps and of the end, and multipliers times what the steps miss."""
    z, end = jnp.concatenate([dx[:-1], du], axis=1), dx[-1]
    cost = jnp.sum(program.gradients * z) + jnp.einsum("ki,kij,kj->", z, program.curvatures, z) / 2
    missed = jnp.einsum("kij,kj->ki", program.slopes, z) + program.missed - dx[1:]
    return cost + program.end_gradient @ end + end @ program.end_curvature @ end / 2 + jnp.sum(multipliers * missed)


def test_the_recursion_meets_the_conditions_of_an_optimum():
    program = horizon()
    slopes = jax.jit(jax.grad(lagrangian, argnums=(1, 2, 3)))
    for free in (None, FREE):
        solve = jax.jit(lambda program, free=free: least_cost(program, free))
        solution = solve(program)
        unknowns = solution.dx, solution.du, solution.multipliers
        of_x, *others = slopes(program, *unknowns)
        fixed = np.ones(n, bool) if free is None else ~free
        assert_array_equal(solution.dx[0][fixed], 0.0)
        for slope in (of_x[0][~fixed], of_x[1:], *others):
            assert_allclose(slope, 0.0, atol=1e-8)
        assert solution.convex and not solve(horizon(-1.0)).convex


def test_a_regulator_that_varies_in_time_has_the_gains_of_the_recursion():
    slopes = horizon().slopes
    end = 2 * np.eye(n)
    still = np.zeros((N, n)), np.zeros((N, n + m))
    weights = np.tile(np.diag([1.0] * n + [0.5] * m), (N, 1, 1))
    program = Horizon(slopes, *still, weights, np.zeros(n), end)
    found = time_varying_lqr(slopes[..., :n], slopes[..., n:], np.eye(n), 0.5 * np.eye(m), end)
    assert_allclose(found.K, -jax.jit(least_cost)(program).K, rtol=1e-10, atol=1e-12)
