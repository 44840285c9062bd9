"""Optimal trajectories against Riccati's recursion, against the conditions of an optimum, and on a cart-pole."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import TrajectoryProblem, field_of, first_plan, improve, mpc, optimise, time_varying_lqr
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import CLASSICAL, runge_kutta
from dln_jax.scenes.poles import cart_pole
from dln_jax.solvers.ending import reason
from dln_jax.types import InputError

RANDOM = np.random.default_rng(0)
F, G = np.eye(3) + 0.2 * RANDOM.normal(size=(3, 3)), RANDOM.normal(size=(3, 2))
START = np.array([1.0, -2.0, 0.5])
LINEAR = TrajectoryProblem(
    lambda x, u: jnp.asarray(F) @ x + jnp.asarray(G) @ u, lambda x, u: x @ x + 0.5 * u @ u, lambda x: 2 * x @ x
)
N = 8


def test_a_linear_problem_takes_one_step_to_the_recursion():
    undamped = first_plan(LINEAR, START, np.zeros((N, 2)))._replace(damping=jnp.asarray(0.0))
    plan = jax.jit(functools.partial(improve, LINEAR))(undamped)
    # l = x Q x, without the half.
    known = time_varying_lqr(np.tile(F, (N, 1, 1)), np.tile(G, (N, 1, 1)), np.eye(3), 0.5 * np.eye(2), 2 * np.eye(3))
    np.testing.assert_allclose(plan.K, -known.K, atol=1e-10)
    assert float(plan.cost) == pytest.approx(START @ np.asarray(known.S[0]) @ START, rel=1e-12)
    assert reason(plan.ending) == "has not ended: a single iteration cannot tell"


@functools.cache
def solver(tolerance):
    """(limit, x, u) -> plan: limits are arguments, so that all tests share two programs."""

    def solve(limit, x, u):
        return optimise(LINEAR._replace(lower=-limit, upper=limit), x, u, tolerance=tolerance)

    return jax.jit(solve)


def total(problem, x, u):
    cost = 0.0
    for each in u:
        cost += problem.cost(x, each)
        x = problem.step(x, each)
    return cost + problem.final_cost(x)


@pytest.mark.parametrize("limit", [0.3, 0.8])
def test_limits_hold_and_the_rest_is_stationary(limit):
    plan = solver(1e-9)(limit, START, np.zeros((N, 2)))
    slope = np.asarray(jax.jit(jax.grad(functools.partial(total, LINEAR, START)))(plan.u))
    u = np.asarray(plan.u)
    inside = np.abs(u) < limit - 1e-6
    assert np.abs(u).max() <= limit and inside.any() and not inside.all()
    np.testing.assert_allclose(slope[inside], 0.0, atol=1e-6)
    assert (slope[~inside] * u[~inside] < 0).all()


@pytest.mark.slow
def test_a_plan_says_why_it_ended():
    u, solve = np.zeros((N, 2)), functools.partial(solver(1e-9), np.inf)
    plan = solve(START, u)
    assert plan.converged
    assert solve(START, plan.u).converged  # no cost is lower than the minimum
    assert reason(optimise(LINEAR, START, u, iterations=1).ending).startswith("used up its iterations")
    lost = solve(START * np.nan, u)
    assert not lost.converged
    assert "not finite" in reason(lost.ending)
    # Every slope points uphill: gradients of the wrong sign.
    uphill = LINEAR._replace(final_cost=lambda x: 2 * x @ x + 100 * (x @ x - 2 * jax.lax.stop_gradient(x @ x)))
    assert not optimise(uphill._replace(cost=lambda x, u: u @ u), START, 1 + u, iterations=30).converged


def cart_pole_problem(dt):
    scene = cart_pole()
    field = field_of(dynamics(scene.energies), np.asarray(scene.needs.actuation))
    return TrajectoryProblem(
        lambda x, u: runge_kutta(CLASSICAL, lambda t, state: field(state, u))(0.0, x, dt),
        lambda x, u: dt * (x[0] ** 2 + 2 * (1 - jnp.cos(x[1])) + 0.1 * (x[2] ** 2 + x[3] ** 2) + 0.01 * u[0] ** 2),
        lambda x: 50 * (x[0] ** 2 + 2 * (1 - jnp.cos(x[1])) + 0.1 * (x[2] ** 2 + x[3] ** 2)),
        -10.0,
        10.0,
    )


DOWN = np.array([0.0, np.pi, 0.0, 0.0])


@pytest.mark.slow
def test_a_cart_pole_swings_up_within_its_limits_and_predictive_plans_hold_it():
    problem = cart_pole_problem(0.04)
    u = 0.5 * np.sin(np.linspace(0, 6, 75))[:, None]
    plan = jax.jit(lambda u: optimise(problem, DOWN, u))(u)
    off = np.abs(np.arctan2(np.sin(plan.x[-1, 1]), np.cos(plan.x[-1, 1])))
    assert off < 0.05 and np.abs(plan.u).max() <= 10.0
    for _ in range(3):
        plan = jax.jit(functools.partial(improve, problem))(plan)
    act = jax.jit(mpc(problem))
    x = jnp.asarray(DOWN)
    for _ in range(75):
        u, plan = act(x, plan)
        x = problem.step(x + 1e-3 * RANDOM.normal(size=4), u)
    assert np.abs(np.arctan2(np.sin(x[1]), np.cos(x[1]))) < 0.05 and np.abs(x[0]) < 0.2


def test_other_shapes_are_one_line():
    with pytest.raises(InputError, match="controls \\[N, m\\]"):
        first_plan(LINEAR, START, np.zeros(3))
