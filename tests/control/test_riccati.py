"""Riccati's recursion against the dense conditions of the same quadratic program."""

import jax
import numpy as np
import pytest

from dln_jax.control.riccati import Horizon, least_cost

N, n, m = 5, 3, 2
RANDOM = np.random.default_rng(0)
ROOTS = RANDOM.normal(size=(N, n + m, n + m))
FREE = np.array([True, False, True])
SOLVED = jax.jit(lambda horizon, free: least_cost(horizon, FREE if free else None), static_argnums=1)


def horizon(curvature=1.0):
    return Horizon(
        RANDOM.normal(size=(N, n, n + m)), RANDOM.normal(size=(N, n)), RANDOM.normal(size=(N, n + m)),
        curvature * ROOTS @ ROOTS.transpose(0, 2, 1), RANDOM.normal(size=n), curvature * np.eye(n),
    )  # fmt: skip


def dense(program, free):
    """Minimiser and multipliers of all stages at once, with unknowns x_0, u_0, x_1, ..."""
    size = N * (n + m) + n
    H, g, A, b = np.zeros((size, size)), np.zeros(size), np.zeros((N * n, size)), np.zeros(N * n)
    for k in range(N):
        at, row = slice(k * (n + m), (k + 1) * (n + m)), slice(k * n, (k + 1) * n)
        H[at, at], g[at], b[row] = program.curvatures[k], program.gradients[k], -program.missed[k]
        A[row, at] = program.slopes[k]
        A[row, (k + 1) * (n + m) : (k + 1) * (n + m) + n] = -np.eye(n)
    H[-n:, -n:], g[-n:] = program.end_curvature, program.end_gradient
    fixed = np.eye(size)[:n][~(FREE & free)]
    A, b = np.concatenate([A, fixed]), np.append(b, np.zeros(len(fixed)))
    both = np.linalg.solve(np.block([[H, A.T], [A, np.zeros((len(A), len(A)))]]), np.append(-g, b))
    stages = np.append(both[:size], np.zeros(m)).reshape(N + 1, n + m)
    return stages[:, :n], stages[:-1, n:], both[size : size + N * n].reshape(N, n)


@pytest.mark.parametrize("free", [False, True])
def test_the_recursion_solves_the_dense_conditions(free):
    program = horizon()
    solution = SOLVED(program, free)
    for value, expected in zip((solution.dx, solution.du, solution.multipliers), dense(program, free), strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-8, atol=1e-8)
    assert solution.convex
    np.testing.assert_allclose(solution.dx[0][~(FREE & free)], 0.0)


def test_a_program_without_minimum_is_not_convex():
    assert not SOLVED(horizon(-1.0), False).convex
