"""Separable least squares on sums of exponentials, and linear least squares of badly scaled columns."""

import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.solvers.least_squares import solve, solve_chunks, solve_separable

T = np.linspace(0, 2, 200)
RATES, SIZES = np.array([0.7, 4.0]), np.array([2.0, -3.0, 0.5])


def columns(logarithms, t):
    return jnp.concatenate([jnp.exp(-jnp.exp(logarithms) * t[:, None]), jnp.ones((len(t), 1))], axis=1)


def design(logarithms, t, b):
    return columns(logarithms, t), b


def noisy(seed, noise):
    clean = np.asarray(columns(np.log(RATES), T)) @ SIZES
    return clean + noise * np.random.default_rng(seed).normal(size=len(T))


def test_both_kinds_of_unknowns_are_found():
    solution = solve_separable(design, np.log([1.0, 2.0]), T, noisy(0, 0.0), improvement=1e-15)
    assert solution.converged and solution.rank == 3
    np.testing.assert_allclose(np.exp(solution.nonlinear), RATES, rtol=1e-7)
    np.testing.assert_allclose(solution.linear, SIZES, rtol=1e-6)


def test_errors_are_those_of_repetition():
    noise = 0.01
    every = [solve_separable(design, np.log([1.0, 2.0]), T, noisy(seed, noise)) for seed in range(60)]
    spread = np.std([np.append(fit.linear, fit.nonlinear) for fit in every], axis=0)
    stated = np.sqrt(np.diagonal(every[0].covariance))
    np.testing.assert_allclose(stated, spread, rtol=0.35)


def test_what_no_equation_shows_has_no_part():
    def twice(n, t, b):
        A = columns(n, t)
        return jnp.concatenate([A, A[:, :1], jnp.zeros((len(t), 1))], axis=1), b

    solution = solve_separable(twice, np.log([1.0, 2.0]), T, noisy(0, 0.0), rank_tolerance=1e-10)
    assert solution.rank == 3 and solution.linear[4] == 0
    np.testing.assert_allclose(solution.linear[[0, 3]], [1.0, 1.0], rtol=1e-5)


def test_a_bound_on_steps_keeps_a_start_in_its_valley():
    start = np.log([0.05, 80.0])
    solution = solve_separable(design, start, T, noisy(0, 1e-3), longest_step=0.3, iterations=1)
    assert 0 < np.abs(solution.nonlinear - start).max() <= 0.3


def test_what_is_no_problem_is_refused():
    for start, options, words in (
        (np.zeros((2, 1)), {}, "start has shape"),
        (np.full(2, np.nan), {}, "NaN or infinite entries at the start"),
        (np.zeros(2), {"iterations": 0}, "iterations is 0; expected a positive number"),
    ):
        with one_line(words):
            solve_separable(design, start, T, noisy(0, 0.0), **options)


# Linear least squares of badly scaled columns.
RANDOM = np.random.default_rng(0)
A = RANDOM.normal(size=(60, 4)) * [1e3, 1.0, 1e-2, 1e-4]
X = np.array([1.0, -2.0, 3.0, 4.0])


def in_chunks(A, b, **options):
    return solve_chunks(((A[k : k + 20], b[k : k + 20]) for k in range(0, len(A), 20)), **options)


@pytest.mark.parametrize("way", [solve, in_chunks])
def test_columns_of_any_unit_count_and_what_is_negligible_does_not(way):
    b = A @ X
    solution = way(A, b)
    np.testing.assert_allclose(solution.x, X, rtol=1e-7)
    assert solution.rank == 4
    # A rest of cancelling terms: noise would be projected onto it and divided by it.
    cancelled = 1e-14 * RANDOM.normal(size=(60, 1))
    noisy = b + 0.1 * RANDOM.normal(size=60)
    with_rounding = way(np.hstack([A, cancelled]), noisy, negligible=1e-12)
    assert with_rounding.rank == 4 and with_rounding.x[4] == 0
    np.testing.assert_allclose(with_rounding.x[:4], way(A, noisy).x, rtol=1e-6)


def test_what_is_negligible_is_a_fraction():
    with one_line(r"negligible is 1\.0"):
        solve(A, A @ X, negligible=1.0)
