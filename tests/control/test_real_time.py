"""Predictive control in real time: optima of its smooth problem, constraints, knots, and operations in C."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose

from dln_jax.control.constraints import worst_violation
from dln_jax.control.real_time import BARRIER, feedback, improve, mpc, prepare
from dln_jax.control.shooting import shoot
from dln_jax.control.trajectories import TrajectoryProblem, first_plan
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.solvers.ending import Ending, reason

N, DT = 20, 0.1
BLOCK = TrajectoryProblem(
    lambda x, u: jnp.stack([x[0] + DT * x[1] + DT**2 / 2 * u[0], x[1] + DT * u[0]]),
    lambda x, u: DT * (x[0] ** 2 + 0.1 * u @ u),
    lambda x: 5 * x @ x,
    -1.5,
    1.5,
    upper_x=np.array([np.inf, 0.6]),
)
"""A mass of 1 kg, drawn from -1 m to the origin by at most 1.5 N, at most at 0.6 m/s."""
START = np.array([-1.0, 0.0])
IDLE = np.zeros((N, 1))
ALONG = np.tile(START, (N + 1, 1))


@jax.jit
def improved(x, barrier=BARRIER):
    """The plan of 40 iterations, along which the barrier falls."""
    falling = lambda k, plan: improve(BLOCK, plan, barrier=jnp.maximum(barrier, 1e-1 * 0.5**k))  # noqa: E731
    return jax.lax.fori_loop(0, 40, falling, first_plan(BLOCK, x, IDLE))


def test_iterations_approach_the_optimum_as_the_barrier_falls():
    """The gap of a barrier method is at most μ times the number of constraints."""
    best = jax.jit(lambda: shoot(BLOCK, START, ALONG, IDLE))()
    gaps = []
    for barrier in (1e-2, 1e-4):
        plan = improved(START, barrier)
        assert np.abs(plan.u).max() < 1.5 and plan.x[:, 1].max() < 0.6
        assert int(plan.ending) == Ending.UNDECIDED
        cost = sum(map(BLOCK.cost, plan.x[:-1], plan.u)) + BLOCK.final_cost(plan.x[-1])
        gaps.append(float(cost - best.plan.cost))
        assert 0 < gaps[-1] < barrier * 3 * N
    assert gaps[1] < gaps[0] / 20


def test_feedback_is_the_derivative_of_the_optimal_control():
    start = np.array([-0.2, 0.1])
    step = 1e-4  # near enough for a force within the limits
    plan = improved(start, 1e-2)
    for axis in step * np.eye(2):
        ahead, behind = (improved(start + way, 1e-2).u[0] for way in (axis, -axis))
        moved = feedback(BLOCK, plan, start + axis) - feedback(BLOCK, plan, start - axis)
        assert_allclose(moved, ahead - behind, rtol=2e-2)


def test_a_loop_settles_within_its_constraints_in_spite_of_pushes():
    act = jax.jit(mpc(BLOCK))
    plan = improved(START)
    x = jnp.asarray(START)
    random = np.random.default_rng(0)
    controls = []
    for _ in range(60):
        u, plan = act(x, plan)
        controls.append(float(u[0]))
        x = BLOCK.step(x, u) + 1e-3 * random.normal(size=2)
        assert x[1] < 0.61
    assert np.abs(controls).max() <= 1.5 and max(controls) > 1.0 and np.abs(x).max() < 0.02


def test_a_sample_without_feasible_plan_says_so():
    lost = improved(jnp.array([-1.0, 2.0]))  # faster than allowed, and 1.5 N brake in 0.9 s
    assert np.isfinite(lost.u).all() and reason(lost.ending).startswith("ended where constraints are violated")
    assert worst_violation(BLOCK, lost).startswith("the upper limit of state 1 at knot 1 is violated by 1.2")


STEEP = BLOCK._replace(
    step=lambda x, u: BLOCK.step(x, u) + DT * jnp.stack([0.0, 1.0]) * x[0] ** 3, upper_x=np.inf, upper=30.0, lower=-30.0
)
"""A spring that pushes the mass away ever harder."""


@pytest.mark.slow
def test_plans_recover_from_gains_that_diverge_and_from_a_reading_that_is_not_finite():
    act = jax.jit(mpc(STEEP))
    plan = first_plan(STEEP, START / 2, IDLE)
    x = jnp.asarray(START) / 2
    for sample in range(50):
        if sample == 10:  # throws the prediction to infinity
            plan = plan._replace(K=plan.K + 1e200)
        lost = sample == 20
        u, plan = act(x * np.nan if lost else x, plan)
        assert np.isnan(u).all() == lost and (int(plan.ending) == Ending.NOT_FINITE) == lost
        assert all(np.isfinite(leaf).all() for leaf in plan)
        x = STEEP.step(x, jnp.zeros(1) if lost else u)
    assert int(plan.ending) == Ending.UNDECIDED and np.abs(x).max() < 0.05


@pytest.mark.slow
def test_a_far_obstacle_and_unequal_limits_leave_the_mass_at_its_goal():
    """Before, an obstacle 1.5 m away moved the mass by millimetres."""
    obstacle = BLOCK._replace(upper_x=np.inf, lower=-2.0, states=lambda x: x[:1] - 1.5)
    act = jax.jit(mpc(obstacle))
    plan = first_plan(obstacle, START, IDLE)
    x = jnp.asarray(START)
    for _ in range(120):
        u, plan = act(x, plan)
        x = obstacle.step(x, u)
    assert np.abs(x).max() < 1e-6 and int(plan.ending) == Ending.UNDECIDED


def test_one_reading_that_is_not_finite_costs_one_command_in_c_too(tmp_path):
    problem = STEEP._replace(upper_x=np.array([np.inf, 0.6]))
    first = first_plan(problem, START / 2, np.zeros((4, 1)))

    def renew(reading, u, x, K, damping):
        plan = first._replace(u=u, x=x, K=K, damping=damping)
        after = prepare(problem, plan, reading)
        new = {f"new_{name}": getattr(after, name) for name in ("u", "x", "K", "damping")}
        return {"force": feedback(problem, plan, reading), "ending": after.ending, **new}

    memory = [np.asarray(leaf) for leaf in (first.u, first.x, first.K, first.damping)]
    export_c({"renew": (renew, (START, *memory))}, tmp_path, stack=2**20)
    in_c, in_jax = load_c(tmp_path).renew, jax.jit(renew)
    memory_in_c = memory
    for reading in (START / 2, START * np.nan, START / 2.2):
        got, expected = in_c(reading, *memory_in_c)._asdict(), in_jax(reading, *memory)
        for name, value in expected.items():
            assert_allclose(got[name], value, rtol=1e-9, atol=1e-12)
            assert np.isfinite(value).all() == (name != "force" or np.isfinite(reading).all())
        memory, memory_in_c = (
            [answer[f"new_{name}"] for name in ("u", "x", "K", "damping")] for answer in (expected, got)
        )


def test_knots_move_a_reference_and_constraints_that_depend_on_time():
    """A gate that opens at 1 s: the mass waits before it, in plans of `shoot` and in real time alike."""
    t = DT * np.arange(N + 41)
    timed = BLOCK._replace(
        step=lambda x, u, t: BLOCK.step(x, u),
        cost=lambda x, u, t: BLOCK.cost(x, u),
        final_cost=lambda x, t: BLOCK.final_cost(x),
        states=lambda x, t: jnp.where(t < 1.0, x[:1] + 0.5, -1.0),
        soft=(50.0, 0.0),
        upper_x=np.inf,
    )
    first = timed._replace(knots=t[: N + 1])
    solved = jax.jit(lambda: shoot(first, START, ALONG, IDLE))()
    assert solved.converged and solved.plan.x[9, 0] <= -0.5 + 1e-6 < solved.plan.x[12, 0]
    plan = first_plan(first, START, IDLE)
    x = jnp.asarray(START)
    act = jax.jit(mpc(timed))
    again = jax.jit(functools.partial(improve, first))
    for _ in range(25):
        plan = again(plan)
    assert_allclose(plan.x, solved.plan.x, atol=5e-2)
    for k in range(40):
        assert k * DT >= 1.0 or x[0] < -0.49
        u, plan = act(x, plan, t[k : k + N + 2])
        x = BLOCK.step(x, u)
    assert abs(x[0]) < 0.02


@pytest.mark.slow
def test_an_equation_of_the_end_holds_within_the_width_of_its_price():
    problem = BLOCK._replace(final_cost=lambda x: 0 * x[0], end=lambda x: x, upper_x=np.inf)
    again = lambda _, plan: improve(problem, plan)  # noqa: E731
    plan = jax.jit(lambda plan: jax.lax.fori_loop(0, 60, again, plan))(first_plan(problem, START, IDLE))
    assert np.abs(plan.x[-1]).max() < 1e-4 and int(plan.ending) == Ending.UNDECIDED


def test_a_free_first_state_is_refused():
    with one_line("it is measured in real time"):
        improve(BLOCK._replace(free=np.array([True, False])), first_plan(BLOCK, START, IDLE))
