"""No disturbance within its bounds makes the cost rise faster than the worst disturbance's."""

import jax.numpy as jnp
import numpy as np
from calls import one_line

from dln_jax.control.optimal.problem import worst_disturbance

A, B = np.array([[0.0, 1.0], [2.0, -0.3]]), np.array([[0.0, 0.5], [1.5, 0.0]])
BOUNDS = {"state": 0.3, "action": 0.2, "observation": 0.1, "parameters": 0.15}
X, U, P = jnp.array([0.4, -1.0]), jnp.array([0.7, 0.2]), jnp.array([1.2, -0.8])


def plant(x, u, p):
    """Linear in each of the three, so that first order is all there is; but not in all at once."""
    return A @ x + B @ u + p * X


def test_no_disturbance_within_the_bounds_is_worse():
    turns = np.linspace(0, 2 * np.pi, 400)
    directions = np.stack([np.cos(turns), np.sin(turns)])
    signs = np.abs(P)[:, None] * [[1, 1, -1, -1], [1, -1, 1, -1]]
    # One at a time: each adds its own to the rate.
    every = 0.3 * directions, B @ (0.2 * directions), A @ (0.1 * directions), 0.15 * signs * X[:, None]
    for slope in jnp.array([[1.0, 2.0], [-0.3, 0.1], [0.0, -4.0]]):
        worst = float(slope @ worst_disturbance(plant, P, **BOUNDS)(X, slope, U))
        most = sum(np.max(slope @ each) for each in every)
        assert 0.999 * worst < most <= worst * (1 + 1e-12)


def test_without_a_slope_or_a_bound_it_does_nothing():
    assert not np.any(worst_disturbance(plant, P, **BOUNDS)(X, jnp.zeros(2), U))
    assert not np.any(worst_disturbance(plant, P)(X, jnp.ones(2), U))


def test_parameters_stay_where_they_make_sense():
    change = worst_disturbance(plant, P, parameters=0.5, lower=[1.0, -1.0], upper=[1.5, 0.0])
    np.testing.assert_allclose(change(X, jnp.array([1.0, 1.0]), U), [(1.5 - 1.2) * 0.4, -0.2 * -1.0], rtol=1e-12)
    with one_line("bound of action"):
        worst_disturbance(plant, P, action=-1.0)
