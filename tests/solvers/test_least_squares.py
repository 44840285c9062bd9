"""Linear least squares of badly scaled columns."""

import numpy as np
import pytest

from dln_jax.solvers.least_squares import solve, solve_chunks
from dln_jax.types import InputError

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
    # What terms leave that cancel: noise would project onto it and be divided by it.
    cancelled = 1e-14 * RANDOM.normal(size=(60, 1))
    noisy = b + 0.1 * RANDOM.normal(size=60)
    with_rounding = way(np.hstack([A, cancelled]), noisy, negligible=1e-12)
    assert with_rounding.rank == 4 and with_rounding.x[4] == 0
    np.testing.assert_allclose(with_rounding.x[:4], way(A, noisy).x, rtol=1e-6)


def test_what_is_negligible_is_a_fraction():
    with pytest.raises(InputError, match=r"negligible is 1\.0"):
        solve(A, A @ X, negligible=1.0)
