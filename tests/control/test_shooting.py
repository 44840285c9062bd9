"""Multiple and single shooting against Riccati's recursion, conditions of an optimum and finite differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose

from dln_jax.control.real_time import improve
from dln_jax.control.regulators import time_varying_lqr
from dln_jax.control.shooting import shoot
from dln_jax.control.state_space import field_of, integrated
from dln_jax.control.trajectories import TrajectoryProblem, first_plan
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import gauss_legendre4, implicit_midpoint, radau3
from dln_jax.scenes.pendulums import cart_pole, flexible_cart_pole
from dln_jax.solvers.ending import reason

RANDOM = np.random.default_rng(0)
F, G = np.eye(3) + 0.2 * RANDOM.normal(size=(3, 3)), RANDOM.normal(size=(3, 2))
START = np.array([1.0, -2.0, 0.5])
LINEAR = TrajectoryProblem(
    lambda x, u: jnp.asarray(F) @ x + jnp.asarray(G) @ u, lambda x, u: x @ x + 0.5 * u @ u, lambda x: 2 * x @ x
)
N = 8
STILL = np.zeros((N, 2))


def test_a_linear_problem_takes_one_iteration_to_the_recursion():
    guess = RANDOM.normal(size=(N + 1, 3)), RANDOM.normal(size=(N, 2))
    solve = jax.jit(lambda x: shoot(LINEAR, x, *guess, iterations=2))
    found = solve(START)
    undamped = first_plan(LINEAR, START, STILL)._replace(damping=jnp.asarray(0.0))
    plan = jax.jit(functools.partial(improve, LINEAR))(undamped)
    assert reason(plan.ending) == "has not ended: a single iteration cannot tell"
    # l = x Q x, without the half.
    known = time_varying_lqr(np.tile(F, (N, 1, 1)), np.tile(G, (N, 1, 1)), np.eye(3), 0.5 * np.eye(2), 2 * np.eye(3))
    for one in (found.plan, plan):
        assert_allclose(one.K, -known.K, atol=1e-10)
        assert one.cost == pytest.approx(START @ np.asarray(known.S[0]) @ START, rel=1e-12)
    # The cost to go is xᵀ S x.
    assert_allclose(found.multipliers[0], 2 * known.S[1] @ found.plan.x[1], rtol=1e-9)
    assert found.defect < 1e-13
    lost = solve(START * np.nan)
    assert np.isnan(lost.plan.cost) and not lost.converged


def test_limits_hold_and_the_rest_is_stationary():

    @jax.jit
    def solve(limit, x, u):
        limited = LINEAR._replace(lower=-limit, upper=limit)
        return shoot(limited, x, None, u, method="single", tolerance=1e-9).plan

    def total(controls):
        x = START
        cost = 0.0
        for u in controls:
            cost += LINEAR.cost(x, u)
            x = LINEAR.step(x, u)
        return cost + LINEAR.final_cost(x)

    for limit in (0.3, 0.8):
        u = np.asarray(solve(limit, START, STILL).u)
        slope = np.asarray(jax.grad(total)(u))
        inside = np.abs(u) < limit - 1e-6
        assert np.abs(u).max() <= limit and inside.any() and not inside.all()
        assert_allclose(slope[inside], 0.0, atol=1e-6)
        assert (slope[~inside] * u[~inside] < 0).all()
    plan = solve(np.inf, START, STILL)
    assert plan.converged and solve(np.inf, START, plan.u).converged  # no cost is lower than the minimum
    lost = solve(np.inf, START * np.nan, STILL)
    assert not lost.converged and "not finite" in reason(lost.ending)


def test_swing_up_of_a_cart_pole_converges_quadratically_and_its_gains_are_derivatives_of_the_optimum():
    scene = cart_pole()
    steps = 50
    dt = 0.04
    field = field_of(dynamics(scene.energies), np.asarray(scene.needs.actuation))
    off = lambda x: x[0] ** 2 + 2 * (1 - jnp.cos(x[1])) + 0.1 * (x[2] ** 2 + x[3] ** 2)  # noqa: E731
    cost = lambda x, u: dt * (off(x) + 0.01 * u[0] ** 2)  # noqa: E731
    problem = TrajectoryProblem(integrated(field, dt), cost, lambda x: 50 * off(x))

    @jax.jit
    def solve(x, states, u, limit):
        return shoot(problem._replace(lower=-limit, upper=limit), x, states, u, tolerance=1e-10)

    down = np.array([0.0, np.pi, 0.0, 0.0])
    found = solve(down, np.linspace(down, 0 * down, steps + 1), np.zeros((steps, 1)), 10.0)  # a guess that is no motion
    assert found.converged and found.defect < 1e-8 and np.abs(found.plan.u).max() <= 10.0
    assert (np.abs(found.plan.u) > 9.999).any() and np.cos(found.plan.x[-1, 1]) > 0.999
    limit = 1e3  # where none is reached, u is a smooth function of the start
    first = solve(down, found.plan.x, found.plan.u, limit)
    exact = solve(down, first.plan.x + 1e-2, first.plan.u, limit)
    assert exact.converged and exact.iterations <= 15
    assert exact.plan.cost == pytest.approx(float(first.plan.cost), rel=1e-9)
    for axis, gain in zip(1e-3 * np.eye(4), exact.plan.K[0, 0], strict=True):
        ahead, behind = (solve(down + way, exact.plan.x, exact.plan.u, limit).plan.u[0, 0] for way in (axis, -axis))
        assert float(ahead - behind) / 2e-3 == pytest.approx(float(gain), rel=1e-3)


def test_implicit_steps_have_the_derivatives_of_finite_differences():
    scene = flexible_cart_pole(stiffness=2e5)  # an example of the documentation plans through it
    field = field_of(dynamics(scene.closed_form), np.asarray(scene.needs.actuation))
    stiff = integrated(field, 0.02, method=implicit_midpoint)
    step = jax.jit(stiff)
    x = 0.01 * jnp.arange(1.0, 7.0).at[1].set(1e-4)
    u = jnp.array([2.0])
    slopes = jax.jit(jax.jacfwd(stiff, argnums=(0, 1)))(x, u)
    for slope, by, size in ((slopes[0], lambda e: step(x + e, u), 6), (slopes[1], lambda e: step(x, u + e), 1)):
        numeric = np.stack([(by(1e-6 * each) - by(-1e-6 * each)) / 2e-6 for each in np.eye(size)], axis=1)
        assert_allclose(slope, numeric, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_radau_is_of_order_three_and_forgets_what_decays_fast():
    field = lambda x, u: -u * x  # noqa: E731
    one = jnp.ones(1)
    ends = []
    for method, order in ((radau3, 3), (gauss_legendre4, 4)):
        steps = [integrated(field, 1.0, method=method, substeps=n) for n in (4, 8)]
        errors = [abs(step(one, one)[0] - np.exp(-1)) for step in steps]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.2)
        ends.append(abs(integrated(field, 1.0, method=method)(one, 1e6 * one)[0]))
    assert ends[0] < 1e-5 and ends[1] > 0.99


def test_other_shapes_are_refused():
    with one_line(r"expected \[n\], \[N\+1, n\] and \[N, m\]"):
        shoot(LINEAR, START, np.zeros((N, 3)), STILL)
    with one_line(r"controls \[N, m\]"):
        first_plan(LINEAR, START, np.zeros(3))
