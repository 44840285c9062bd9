"""A plan that converged is a minimum and keeps all constraints; saddles and problems without solution are named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control.constraints import worst_violation
from dln_jax.control.shooting import shoot
from dln_jax.control.trajectories import TrajectoryProblem
from dln_jax.solvers.ending import Ending, reason

N, DT = 16, 0.1
FREE = lambda x: 0.0 * x[0]  # noqa: E731


def accelerated(x, u):
    return jnp.stack([x[0] + DT * x[1] + DT**2 / 2 * u[0], x[1] + DT * u[0]])


@pytest.mark.parametrize("soft", [None, pytest.param((1.0, 0.0), marks=pytest.mark.slow)])
def test_a_mass_that_passes_the_wall_across_its_way_has_not_converged(soft):
    """A mass is to move by 1 m, and the wall is between 0.3 and 0.7 m; a low price lets it pass."""
    depth = lambda x: 0.04 - (x[:1] - 0.5) ** 2  # noqa: E731
    problem = TrajectoryProblem(accelerated, lambda x, u: DT * u @ u, FREE, -2.0, 2.0, states=depth, soft=soft)
    problem = problem._replace(end=lambda x: x - jnp.array([1.0, 0.0]))
    solution = jax.jit(lambda: shoot(problem, np.zeros(2), np.zeros((N + 1, 2)), np.zeros((N, 1))))()
    assert not solution.converged
    if soft is None:
        assert int(solution.ending) == Ending.INFEASIBLE and np.isinf(solution.objective)
    else:
        excess = np.maximum(np.asarray(jax.vmap(depth)(solution.plan.x)), 0.0)
        assert float(solution.objective - solution.plan.cost) == pytest.approx(excess.sum(), rel=1e-6)
        assert solution.violation == pytest.approx(excess.max()) and excess.max() > 0.03
        assert reason(solution.ending).startswith("is optimal at its prices, but violates soft constraints")
        assert worst_violation(problem, solution.plan).startswith("constraint 0 on the states at knot")


@pytest.mark.parametrize("method", ["multiple", "single"])
def test_the_best_of_several_guesses_has_the_least_objective(method):
    """A well of value 0 at -1, whose price is 5, beats no well of value 0.5 at 1, which costs nothing more."""
    final = lambda x: 10 * (x[0] ** 2 - 1) ** 2 + 0.25 * (x[0] + 1)  # noqa: E731
    problem = TrajectoryProblem(
        lambda x, u: x + u, lambda x, u: 0.0 * u[0], final, states=lambda x: -x, soft=(5.0, 0.0)
    )
    start = np.array([0.05])
    ends = np.array([1.0, -1.0])
    u = (ends - start)[:, None, None]
    states = np.stack([np.full(2, start), ends], axis=1)[:, :, None]
    plan = jax.jit(lambda: shoot(problem, start, states[0], u[0], method=method, starts=(states[1:], u[1:])).plan)()
    assert float(plan.x[-1, 0]) > 0.9 and plan.converged


STEPS = 4


def test_single_shooting_is_tried_where_multiple_shooting_fails():
    """The end has a root at -2.1, and its least violation nearby at 1, where the states of the guess are."""
    problem = TrajectoryProblem(lambda x, u: x + u, lambda x, u: u @ u, FREE, end=lambda x: x**3 - 3 * x + 3)
    guess = np.ones(1), np.ones((STEPS + 1, 1)), np.full((STEPS, 1), -0.75)
    assert int(shoot(problem, *guess, method="multiple").ending) == Ending.INFEASIBLE
    solution = shoot(problem, *guess)
    assert solution.plan.x[-1, 0] < -2 and solution.verdict == "single shooting converged within the tolerance"


def hill(price):
    """Steps to one of the wells at -1 and 1 cost price u²: the sum X of n equal ones has X² = 1 - price / 2 n."""
    return TrajectoryProblem(lambda x, u: x + u, lambda x, u: price * u @ u, lambda x: jnp.sum((x**2 - 1) ** 2), -5, 5)


def test_a_plan_leaves_the_top_of_a_hill_but_not_a_minimum():
    """At the price 2 n the second derivative along the hill vanishes, and the fourth does not."""
    solve = jax.jit(lambda price: shoot(hill(price), np.zeros(1), np.zeros((STEPS + 1, 1)), np.zeros((STEPS, 1))))
    for price in (0.5, 2 * STEPS * (1 - 1e-3)):
        solution = solve(price)
        way = np.sqrt(1 - price / (2 * STEPS))
        assert solution.converged and abs(float(solution.plan.x[-1, 0])) == pytest.approx(way, rel=1e-5)
    for price in (4.0 * STEPS, 2.0 * STEPS):
        solution = solve(price)
        assert solution.converged and np.abs(solution.plan.x).max() < 1e-6


def test_redundant_controls_are_no_saddle():
    """Two motors move one mass, and nothing decides between them."""
    problem = TrajectoryProblem(lambda x, u: x + u[:1] + u[1:], lambda x, u: x @ x, lambda x: x @ x, -0.3, 0.3)
    solution = shoot(problem, np.ones(1), np.ones((STEPS + 1, 1)), np.zeros((STEPS, 2)))
    assert solution.converged
    np.testing.assert_allclose(solution.plan.u[0], -0.3, atol=1e-4)


MOST = np.array([1.0, 2.0])
"""Limits of a unicycle, m/s and rad/s."""


def ridden(x, u):
    heading = x[2] + DT / 2 * u[1]
    return x + DT * jnp.stack([u[0] * jnp.cos(heading), u[0] * jnp.sin(heading), u[1]])


def test_a_goal_within_reach_is_reached_and_one_beyond_is_infeasible_by_the_rest_of_the_way():
    """A unicycle at rest cannot move sideways: to first order it cannot reach the second place."""
    problem = TrajectoryProblem(ridden, lambda x, u: DT * u @ u, FREE, -MOST, MOST)

    @jax.jit
    def solve(place):
        guess = np.zeros((21, 3)), np.zeros((20, 2))  # 2 s
        return shoot(problem._replace(end=lambda x: x - place), np.zeros(3), *guess)

    for place in ([1.9, 0.0, 0.0], [0.0, 1.0, 0.0]):
        solution = solve(np.array(place))
        assert solution.converged and solution.violation < 1e-7
        np.testing.assert_allclose(solution.plan.x[-1], place, atol=1e-7)
    for distance in (2.5, 3.0):
        place = np.array([distance, 0.0, 0.0])
        solution = solve(place)
        assert int(solution.ending) == Ending.INFEASIBLE
        assert solution.violation == pytest.approx(distance - 2.0, abs=1e-5)
        assert max(solution.stationarity, solution.feasibility, solution.complementarity) <= 2e-6
        text = worst_violation(problem._replace(end=lambda x, place=place: x - place), solution.plan)
        assert text == f"equation 0 of the end is violated by {distance - 2:.3g}"
