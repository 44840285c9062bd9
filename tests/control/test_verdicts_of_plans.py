"""A plan that converged is a minimum and keeps all constraints; saddles and problems without solution are named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import TrajectoryProblem, free_time, optimise, shoot, worst_violation
from dln_jax.solvers.ending import Ending, reason

N, DT = 16, 0.1
FREE = lambda x: 0.0 * x[0]  # noqa: E731


def into_disc(x):
    """Squared depth of the middle of the outer link and of the tip of an arm of two links of 1 m in a disc."""
    elbow = jnp.stack([jnp.cos(x[0]), jnp.sin(x[0])])
    tip = elbow + jnp.stack([jnp.cos(x[0] + x[1]), jnp.sin(x[0] + x[1])])
    centre = jnp.array([1.6, 0.1])
    return jnp.stack([0.3**2 - jnp.sum((point - centre) ** 2) for point in ((elbow + tip) / 2, tip)])


def accelerated(x, u):
    q, qd = jnp.split(x, 2)
    return jnp.concatenate([q + DT * qd + DT**2 / 2 * u, qd + DT * u])


def test_an_arm_that_converged_is_never_inside_a_disc():
    """From eight guesses, most of which cross the disc."""
    first, last = np.array([-0.8, 0.4, 0.0, 0.0]), np.array([0.8, 0.4, 0.0, 0.0])
    final = lambda x: 50 * jnp.sum((x - last) ** 2)  # noqa: E731
    problem = TrajectoryProblem(accelerated, lambda x, u: 0.1 * DT * u @ u, final, -8.0, 8.0, states=into_disc)
    bend = np.sin(np.pi * np.linspace(0, 1, N + 1))[:, None] * [0.0, 1.0, 0.0, 0.0]
    guesses = np.linspace(first, last, N + 1) + np.linspace(-1.0, 2.5, 8)[:, None, None] * bend
    solutions = jax.jit(jax.vmap(lambda guess: shoot(problem, first, guess, np.zeros((N, 2)))))(guesses)
    depth = np.asarray(jax.vmap(jax.vmap(into_disc))(solutions.plan.x[:, 1:])).max(axis=(1, 2))
    converged = np.asarray(solutions.ending) == Ending.CONVERGED
    assert (depth[converged] <= 1e-6).all() and converged.sum() >= 6


def test_a_mass_that_passes_the_wall_across_its_way_has_not_converged():
    """A mass is to move by 1 m, and the wall is between 0.3 and 0.7 m; a low price lets it pass."""
    depth = lambda x: 0.04 - (x[:1] - 0.5) ** 2  # noqa: E731
    hard = TrajectoryProblem(accelerated, lambda x, u: DT * u @ u, FREE, -2.0, 2.0, states=depth)
    hard = hard._replace(end=lambda x: x - jnp.array([1.0, 0.0]))
    soft = hard._replace(soft=(1.0, 0.0))
    stopped, passed = (
        jax.jit(lambda problem=problem: shoot(problem, np.zeros(2), np.zeros((N + 1, 2)), np.zeros((N, 1))))()
        for problem in (hard, soft)
    )
    assert int(stopped.ending) == Ending.INFEASIBLE and not stopped.converged and np.isinf(stopped.objective)
    assert int(passed.ending) == Ending.EXCEEDED and not passed.converged
    excess = np.maximum(np.asarray(jax.vmap(depth)(passed.plan.x)), 0.0)
    assert passed.objective - passed.plan.cost == pytest.approx(excess.sum(), rel=1e-6)
    assert passed.violation == pytest.approx(excess.max()) and excess.max() > 0.03
    assert reason(passed.ending).startswith("is optimal at its prices, but violates soft constraints")
    assert worst_violation(soft, passed.plan).startswith("constraint 0 on the states at knot")


@pytest.mark.parametrize("solve", ["shoot", "optimise"])
def test_the_best_of_several_guesses_has_the_least_objective(solve):
    """A well of value 0 at -1, whose price is 5, beats no well of value 0.5 at 1, which costs nothing more."""
    final = lambda x: 10 * (x[0] ** 2 - 1) ** 2 + 0.25 * (x[0] + 1)  # noqa: E731
    problem = TrajectoryProblem(
        lambda x, u: x + u, lambda x, u: 0.0 * u[0], final, states=lambda x: -x, soft=(5.0, 0.0)
    )
    start, ends = np.array([0.05]), np.array([1.0, -1.0])
    u = (ends - start)[:, None, None]
    states = np.stack([np.full(2, start), ends], axis=1)[:, :, None]
    if solve == "shoot":
        plan = jax.jit(lambda: shoot(problem, start, states[0], u[0], starts=(states[1:], u[1:])).plan)()
    else:
        plan = jax.jit(lambda: optimise(problem, start, u[0], starts=u[1:]))()
    assert float(plan.x[-1, 0]) > 0.9 and plan.converged


STEPS = 4


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


def ridden(x, u, dt):
    heading = x[2] + dt / 2 * u[1]
    return x + dt * jnp.stack([u[0] * jnp.cos(heading), u[0] * jnp.sin(heading), u[1]])


@pytest.mark.slow
def test_a_goal_within_reach_is_reached_and_one_beyond_is_infeasible_by_the_rest_of_the_way():
    """A unicycle at rest cannot move sideways: to first order it cannot reach the second place."""
    problem = TrajectoryProblem(lambda x, u: ridden(x, u, DT), lambda x, u: DT * u @ u, FREE, -MOST, MOST)

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
        assert int(solution.ending) == Ending.INFEASIBLE and not solution.converged
        assert solution.violation == pytest.approx(distance - 2.0, abs=1e-5)
        assert max(solution.stationarity, solution.feasibility, solution.complementarity) <= 2e-6
        text = worst_violation(problem._replace(end=lambda x, place=place: x - place), solution.plan)
        assert text == f"equation 0 of the end is violated by {distance - 2:.3g}"


@pytest.mark.slow
def test_limits_of_controls_and_durations_hold_in_every_plan():
    """Also where slacks are widened; moving sideways by 1 m by turning and driving takes at least 1 s."""
    settings = {"states": 3, "shortest": 1e-3, "longest": 0.5}
    problem = free_time(ridden, lambda x, u, dt: dt, FREE, **settings)._replace(lower=-MOST, upper=MOST)
    problem = problem._replace(end=lambda x: x[:3] - np.array([0.0, 1.0, 0.0]))
    solve = jax.jit(lambda x, states, u: shoot(problem, x, states, u).plan)
    random, converged = np.random.default_rng(0), []
    for number in range(7):
        x, u = np.array([0.0, 0.0, 0.0, (0.1, 0.3, 0.02)[number % 3]]), random.uniform(-1, 1, (10, 2))
        plan = solve(x, np.linspace(x, [0.0, 1.0, 0.0, x[3]], 11), u)
        assert (np.abs(plan.u) <= MOST + 1e-6).all()
        assert plan.x[:, 3].min() >= 1e-3 - 1e-6 and plan.x[:, 3].max() <= 0.5 + 1e-6
        assert not plan.converged or plan.cost > 1.0
        converged.append(bool(plan.converged))
    assert np.mean(converged) > 0.7
