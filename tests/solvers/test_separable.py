"""Few nonlinear unknowns beside linear ones: sums of exponentials, of known rates and of unknown."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.solvers.separable import solve_separable
from dln_jax.types import InputError

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


def test_the_step_is_that_of_the_projected_residual_near_a_solution():
    """Kaufman's Jacobian leaves out what vanishes with the residual: against differences of the projection."""
    b, n, h = noisy(0, 0.0), np.log(RATES) + 1e-4, 1e-6

    def projected(n):
        A = np.asarray(columns(n, T))
        return A @ np.linalg.lstsq(A, b)[0] - b

    differences = np.stack(
        [(projected(n + h * unit) - projected(n - h * unit)) / (2 * h) for unit in np.eye(2)], axis=1
    )
    A = np.asarray(columns(n, T))
    U, x = np.linalg.qr(A)[0], np.linalg.lstsq(A, b)[0]
    J = np.asarray(jax.jacfwd(lambda n: columns(n, T) @ x)(n))
    np.testing.assert_allclose(J - U @ (U.T @ J), differences, atol=1e-3 * abs(differences).max())
    step = np.linalg.lstsq(differences, -projected(n))[0]
    np.testing.assert_allclose(n + step, np.log(RATES), atol=1e-6)


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


@pytest.mark.parametrize(
    "start, options, message",
    [
        (np.zeros((2, 1)), {}, "start has shape"),
        (np.full(2, np.nan), {}, "NaN or infinite entries at the start"),
        (np.zeros(2), {"iterations": 0}, "iterations is 0; expected a positive number"),
    ],
)
def test_what_is_no_problem_is_refused(start, options, message):
    with pytest.raises(InputError, match=message):
        solve_separable(design, start, T, noisy(0, 0.0), **options)
