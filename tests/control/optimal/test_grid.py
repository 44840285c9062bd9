"""A grid's value is that of a linear-quadratic regulator where there is one, and stays between its neighbours."""

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import lqr
from dln_jax.control.optimal.action_costs import quadratic
from dln_jax.control.optimal.flow import flow
from dln_jax.control.optimal.grid import Grid, interpolated, solve_on_grid
from dln_jax.control.optimal.problem import ControlProblem
from dln_jax.types import InputError

A, B = np.array([[0.0, 1.0], [1.0, -0.2]]), np.array([[0.0], [1.0]])
LINEAR = ControlProblem(
    lambda x: jnp.asarray(A) @ x,
    lambda x: jnp.asarray(B),
    lambda x: x @ x,
    quadratic(2.0),
    0.3,
    [-1.0, -1.0],
    [1.0, 1.0],
    ("prismatic",),
    [0.0, 0.0],
)


def test_the_value_of_a_linear_plant():
    S = lqr(A - 0.15 * np.eye(2), B, np.eye(2), np.eye(1)).S
    found = solve_on_grid(LINEAR, (17, 33), low=[-3, -3], high=[3, 3], most=8.0, dt=0.02)
    x = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    exact = np.einsum("ni,ij,nj->n", x, S, x)
    np.testing.assert_allclose(interpolated(found.grid, found.V, x), exact, atol=5e-3 * exact.max())
    u = -(x @ S @ B)[:, 0]
    # Held for a step, a control is best for the middle of it.
    np.testing.assert_allclose(interpolated(found.grid, found.u, x), u, atol=0.05 * np.abs(u).max())


def test_interpolation_is_cubic_goes_round_and_does_not_overshoot():
    grid = Grid((-np.pi, 0.0), (2 * np.pi / 40, 0.25), (40, 9), (True, False))
    nodes = grid.nodes
    x = np.random.default_rng(1).uniform([-9, 0], [9, 2], (200, 2))
    smooth = lambda x: np.cos(x[..., 0]) + x[..., 1] ** 3 + 10 * x[..., 1]  # noqa: E731
    np.testing.assert_allclose(interpolated(grid, jnp.asarray(smooth(nodes)), x), smooth(x), atol=5e-3)
    jump = jnp.asarray((nodes[..., 1] > 0.9).astype(float))
    values = interpolated(grid, jump, x)
    assert values.min() >= 0 and values.max() <= 1


def test_a_step_and_its_cost():
    x, u = jnp.array([0.3, -0.5]), jnp.array([0.7])
    after, cost = flow(LINEAR, 0.1, substeps=2)(x, u)
    half, first = flow(LINEAR, 0.05)(x, u)
    again, second = flow(LINEAR, 0.05)(half, u)
    np.testing.assert_allclose(after, again, rtol=1e-12)
    assert cost == pytest.approx(float(first + np.exp(-0.3 * 0.05) * second), rel=1e-8)
    held, _ = flow(LINEAR, 0.1, clipped=True)(jnp.array([0.999, 1.0]), u)
    assert held[0] == 1.0


def test_what_is_no_rectangle():
    with pytest.raises(InputError, match="two ascending numbers"):
        solve_on_grid(LINEAR, (33,), low=[1, -3], high=[-1, 3], most=8.0)
