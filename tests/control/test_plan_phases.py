"""Plans that leave saddles, and certificates of problems without solution, against closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import TrajectoryProblem, integrated, optimise, phases, shoot, worst_violation
from dln_jax.solvers.ending import Ending, reason

N = 4
STILL = np.zeros((N + 1, 1)), np.zeros((N, 1))


def hill(price):
    """Steps to one of the wells at -1 and 1 cost price u²: the sum X of N equal ones has X² = 1 - price / 2 N."""
    return TrajectoryProblem(lambda x, u: x + u, lambda x, u: price * u @ u, lambda x: jnp.sum((x**2 - 1) ** 2), -5, 5)


@functools.cache
def from_the_top():
    return jax.jit(lambda price: shoot(hill(price), np.zeros(1), *STILL))


@pytest.mark.parametrize("price", [0.5, 2 * N * (1 - 1e-3)])
def test_a_plan_leaves_the_top_of_a_hill(price):
    solution = from_the_top()(price)
    assert solution.converged
    assert abs(float(solution.plan.x[-1, 0])) == pytest.approx(np.sqrt(1 - price / (2 * N)), rel=1e-5)


@pytest.mark.parametrize("price", [4 * N, 2 * N])
def test_a_minimum_is_no_saddle_even_without_curvature(price):
    """At the price 2 N the second derivative along the hill vanishes, and the fourth does not."""
    solution = from_the_top()(float(price))
    assert solution.converged and np.abs(solution.plan.x).max() < 1e-6


@pytest.mark.slow
def test_a_saddle_that_is_not_left_is_not_converged(monkeypatch):
    monkeypatch.setattr(phases, "MOST_ESCAPES", 0)
    plan = optimise(hill(0.5), np.zeros(1), STILL[1])
    assert int(plan.ending) == Ending.SADDLE and not plan.converged
    assert reason(plan.ending).startswith("ended at a saddle") and np.abs(plan.x).max() < 1e-6


def test_redundant_controls_are_no_saddle():
    """Two motors move one mass, and nothing decides between them."""
    problem = TrajectoryProblem(lambda x, u: x + u[:1] + u[1:], lambda x, u: x @ x, lambda x: x @ x, -0.3, 0.3)
    solution = shoot(problem, np.ones(1), np.ones((N + 1, 1)), np.zeros((N, 2)))
    assert solution.converged
    np.testing.assert_allclose(solution.plan.u[0], -0.3, atol=1e-4)


@pytest.mark.slow
def test_a_pendulum_that_hangs_swings_up_from_the_guess_that_hangs():
    field = lambda x, u: jnp.stack([x[1], 3 * (u[0] + 9.81 / 2 * jnp.sin(x[0]))])  # noqa: E731
    off = lambda x: 2 * (1 - jnp.cos(x[0])) + 0.05 * x[1] ** 2  # noqa: E731
    problem = TrajectoryProblem(
        integrated(field, 0.05), lambda x, u: 0.05 * (off(x) + 0.05 * u @ u), lambda x: 20 * off(x), -2.5, 2.5
    )
    hanging = np.array([np.pi, 0.0])
    solution = shoot(problem, hanging, np.tile(hanging, (61, 1)), np.zeros((60, 1)))
    assert solution.converged and np.cos(solution.plan.x[-1, 0]) > 0.99


STEPS, DT = 20, 0.1
UNICYCLE = TrajectoryProblem(
    lambda x, u: x + DT * jnp.stack([u[0] * jnp.cos(x[2] + DT / 2 * u[1]), u[0] * jnp.sin(x[2] + DT / 2 * u[1]), u[1]]),
    lambda x, u: DT * u @ u, lambda x: 0.0 * x[0], np.array([-1.0, -2.0]), np.array([1.0, 2.0]), soft=None,
)  # fmt: skip
"""At most 1 m/s and 2 rad/s, 2 s."""


@functools.cache
def driven():
    def solve(place):
        problem = UNICYCLE._replace(end=lambda x: x - place)
        return shoot(problem, np.zeros(3), np.zeros((STEPS + 1, 3)), np.zeros((STEPS, 2)))

    return jax.jit(solve)


@pytest.mark.slow
@pytest.mark.parametrize("distance", [2.5, 3.0])
def test_a_goal_out_of_reach_is_infeasible_by_the_rest_of_the_way(distance):
    place = np.array([distance, 0.0, 0.0])
    solution = driven()(place)
    assert int(solution.ending) == Ending.INFEASIBLE and not solution.converged
    assert float(solution.violation) == pytest.approx(distance - 2.0, abs=1e-5)
    assert max(solution.stationarity, solution.feasibility, solution.complementarity) <= 2e-6
    text = worst_violation(UNICYCLE._replace(end=lambda x: x - place), solution.plan)
    assert text == f"equation 0 of the end is violated by {distance - 2:.3g}"
    assert reason(solution.ending).startswith("is locally infeasible")


@pytest.mark.slow
@pytest.mark.parametrize("place", [(1.9, 0.0, 0.0), (0.0, 1.0, 0.0)])
def test_a_goal_within_reach_is_reached_even_from_where_no_slope_leads_to_it(place):
    """A unicycle at rest cannot move sideways: to first order it cannot reach the second place."""
    solution = driven()(np.array(place))
    assert solution.converged and solution.violation < 1e-7
    np.testing.assert_allclose(solution.plan.x[-1], place, atol=1e-7)


@pytest.mark.slow
def test_an_obstacle_around_the_goal_is_infeasible():
    """A mass is to stop 0.1 m from the centre of a disc with a radius of 0.3 m."""
    problem = TrajectoryProblem(
        lambda x, u: jnp.concatenate([x[:2] + DT * x[2:] + DT**2 / 2 * u, x[2:] + DT * u]),
        lambda x, u: DT * u @ u, lambda x: 0.0 * x[0], -2.0, 2.0,
        states=lambda x: 0.09 - jnp.sum((x[:2] - jnp.array([1.0, 0.0])) ** 2)[None],
        end=lambda x: x - jnp.array([1.1, 0.0, 0.0, 0.0]), soft=None,
    )  # fmt: skip
    solution = shoot(problem, np.zeros(4), np.zeros((STEPS + 1, 4)), np.zeros((STEPS, 2)))
    assert int(solution.ending) == Ending.INFEASIBLE
    # A state at e from the goal is at most 0.1 + e from the centre: e >= 0.09 - (0.1 + e)² where both are equal.
    assert float(solution.violation) >= (np.sqrt(1.76) - 1.2) / 2
