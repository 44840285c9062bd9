"""Substitution against LAPACK, on both sides of the size where the written-out form ends."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.linalg import solve_triangular

from dln_jax.solvers.elimination import solve_lower, solve_lower_transposed


@pytest.mark.parametrize("n", [1, 2, 5, 12, 16, 17, 30])
def test_substitution_equals_lapack(n):
    factor = jnp.tril(jax.random.normal(jax.random.key(n), (n, n))) + 4 * jnp.eye(n)
    b = jax.random.normal(jax.random.key(n + 1), (n,))
    np.testing.assert_allclose(solve_lower(factor, b), solve_triangular(factor, b, lower=True), rtol=1e-11)
    expected = solve_triangular(factor, b, lower=True, trans="T")
    np.testing.assert_allclose(solve_lower_transposed(factor, b), expected, rtol=1e-11)


def test_only_the_lower_triangle_is_read():
    factor = jnp.array([[2.0, jnp.nan], [1.0, 4.0]])
    np.testing.assert_allclose(solve_lower(factor, jnp.array([2.0, 9.0])), [1.0, 2.0])
    np.testing.assert_allclose(solve_lower_transposed(factor, jnp.array([4.0, 8.0])), [1.0, 2.0])


def test_a_zero_on_the_diagonal_is_not_hidden():
    assert not jnp.isfinite(solve_lower(jnp.zeros((2, 2)), jnp.ones(2))).all()
