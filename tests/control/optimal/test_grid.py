"""The value on a grid is a linear-quadratic regulator's, and no policy costs less; convergence is stated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose

from dln_jax.control.optimal.action_costs import limited_atan, quadratic
from dln_jax.control.optimal.grid import (
    Grid,
    extrapolated,
    interpolated,
    linear,
    lookahead,
    one_sided_slopes,
    read,
    solve_on_grid,
)
from dln_jax.control.optimal.problem import ControlProblem, flow
from dln_jax.control.regulators import lqr
from dln_jax.solvers.ending import reason

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
    corners = {"low": [-2, -2], "high": [2, 2], "limit": 8.0}
    coarse = solve_on_grid(LINEAR, (33, 65), **corners)
    found = solve_on_grid(LINEAR, (129,), **corners, start=coarse)
    assert coarse.converged and found.converged
    x = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    exact = np.einsum("ni,ij,nj->n", x, S, x)
    assert_allclose(extrapolated(coarse, found, x), exact, atol=5e-3 * exact.max())
    errors = [np.max(np.abs(interpolated(each.grid, each.V, x) - exact)) for each in (coarse, found)]
    assert errors[1] < errors[0] / 2.5  # h² halves twice; the goal's own cell converges more slowly
    u = -(x @ S @ B)[:, 0]
    # Held for a step, a control is best for the middle of it.
    law = jax.vmap(lookahead(LINEAR, found, limit=8.0))
    for control in (interpolated(found.grid, found.u, x), law(x)[:, 0]):
        assert_allclose(control, u, atol=0.05 * np.abs(u).max())


GRID = Grid((-np.pi, 0.0), (2 * np.pi / 40, 0.25), (40, 9), (True, False))


def test_interpolation_is_cubic_goes_round_and_does_not_overshoot():
    nodes = GRID.nodes
    x = np.random.default_rng(1).uniform([-9, 0], [9, 2], (200, 2))
    smooth = lambda x: np.cos(x[..., 0]) + x[..., 1] ** 3 + 10 * x[..., 1]  # noqa: E731
    assert_allclose(interpolated(GRID, jnp.asarray(smooth(nodes)), x), smooth(x), atol=5e-3)
    values = interpolated(GRID, jnp.asarray((nodes[..., 1] > 0.9).astype(float)), x)
    assert values.min() >= 0 and values.max() <= 1


def test_linear_interpolation_is_monotone_and_its_slopes_are_one_sided():
    at = linear(GRID, jnp.asarray(np.random.default_rng(2).uniform([-9, -1], [9, 3], (200, 2))))
    for weights in at[2:]:
        assert weights.min() >= 0
        assert_allclose(weights.sum(axis=0), 1, rtol=1e-12)
    plane = jnp.asarray(3 * GRID.nodes[..., 1])
    assert_allclose(one_sided_slopes(GRID, plane, 1), 3, rtol=1e-12)
    assert_allclose(read(plane, linear(GRID, jnp.array([[2 * np.pi + 0.1, 0.6]]))), [1.8], rtol=1e-12)
    jump = jnp.asarray(np.where(np.arange(40) < 20, 0.0, 1.0))[:, None] * jnp.ones(9)
    before, after = one_sided_slopes(GRID, jump, 0)
    assert before[0, 0] < 0 < after[19, 0]  # across the seam of the circle, and at the jump


@pytest.mark.slow
def test_value_with_ridges_converges_to_what_its_policy_costs():
    """The motor cannot lift the rod (0.6 kg, 0.7 m). Cubic interpolation did not converge here."""
    high = np.array([np.pi, 8.0])
    limit = 0.9
    inertia = 0.6 * 0.7**2 / 3
    problem = ControlProblem(
        lambda x: jnp.stack([x[1], 0.6 * 9.81 * 0.35 / inertia * jnp.sin(x[0])]),
        lambda x: jnp.array([[0.0], [1 / inertia]]),
        lambda x: (np.pi * jnp.sin(x[0] / 2)) ** 2 + 0.1 * x[1] ** 2,
        limited_atan(limit + 1e-3, 0.155),
        0.086,
        -high,
        high,
        ("revolute",),
        np.zeros(2),
    )
    found = solve_on_grid(problem, (51, 101), low=[-np.pi, -14], high=[np.pi, 14], limit=limit)
    assert found.converged and found.change <= 1e-7
    step, law = flow(problem, 0.02), lookahead(problem, found, limit=limit)

    def onwards(number, carry):
        x, total = carry
        x, cost = step(x, law(x))
        return x, total + jnp.exp(-problem.discount * 0.02 * number) * cost

    x = np.random.default_rng(4).uniform(-high, high, (60, 2))
    followed = jax.jit(jax.vmap(lambda x: jax.lax.fori_loop(0, 1000, onwards, (x, 0.0))[1]))(x)
    assert np.median(np.abs(interpolated(found.grid, found.V, x) / followed - 1)) < 1e-2


def test_too_few_improvements_are_not_converged():
    found = solve_on_grid(LINEAR, (17,), low=[-3, -3], high=[3, 3], limit=8.0, improvements=1)
    assert not found.converged
    assert reason(found.ending).startswith("ran out of iterations")


def test_a_step_and_its_cost():
    x, u = jnp.array([0.3, -0.5]), jnp.array([0.7])
    after, cost = flow(LINEAR, 0.1)(x, u)
    half, first = flow(LINEAR, 0.05)(x, u)
    again, second = flow(LINEAR, 0.05)(half, u)
    assert_allclose(after, again, rtol=1e-5)
    assert cost == pytest.approx(float(first + np.exp(-0.3 * 0.05) * second), rel=1e-5)
    held, _ = flow(LINEAR, 0.1, clipped=True)(jnp.array([0.999, 1.0]), u)
    assert held[0] == 1.0


def test_empty_rectangle_is_refused():
    with one_line("two ascending numbers"):
        solve_on_grid(LINEAR, (33,), low=[1, -3], high=[-1, 3], limit=8.0)
