"""Plans with constraints against closed forms and the conditions of an optimum."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax.control.constraints import free_time, with_limits_of, worst_violation
from dln_jax.control.shooting import shoot
from dln_jax.control.trajectories import TrajectoryProblem
from dln_jax.solvers.ending import Ending

N, DT = 20, 0.1


def moved(x, u, dt):
    """A mass of 1 kg on a rail, after dt."""
    return jnp.stack([x[0] + dt * x[1] + dt**2 / 2 * u[0], x[1] + dt * u[0]])


BLOCK = TrajectoryProblem(lambda x, u: moved(x, u, DT), lambda x, u: DT * u @ u, lambda x: 0.0 * x[0])
STILL = np.zeros((N + 1, 2)), np.zeros((N, 1))
TO_ONE = BLOCK._replace(end=lambda x: jnp.stack([x[0] - 1.0, x[1]]))
"""From rest to rest over one metre."""


def test_shortest_time_of_a_mass_is_twice_the_root_of_distance_over_acceleration():
    settings = {"states": 2, "shortest": 1e-3, "longest": 1.0}
    free = free_time(moved, lambda x, u, dt: dt, lambda x: 0.0 * x[0], **settings)._replace(lower=-2.0, upper=2.0)
    start = np.array([0.0, 0.0, 0.1])

    @jax.jit
    def solve(distance):
        problem = free._replace(end=lambda x: jnp.stack([x[0] - distance, x[1]]))
        return shoot(problem, start, np.tile(start, (N + 1, 1)), np.zeros((N, 1)))

    for distance in (1.0, 3.0):
        solution = solve(distance)
        assert solution.converged
        assert solution.plan.cost == pytest.approx(2 * np.sqrt(distance / 2.0), rel=1e-6)
        assert_allclose(solution.plan.u[:, 0], np.where(np.arange(N) < N // 2, 2.0, -2.0), atol=1e-4)


@functools.cache
def at_most(soft=None):
    """Solves for at most 0.6 m/s by a constraint."""
    return shoot(TO_ONE._replace(states=lambda x: x[1:] - 0.6, soft=soft), np.zeros(2), *STILL)


def test_limits_hard_and_soft_constraints_and_single_shooting_give_the_same_plan():
    limited = TO_ONE._replace(upper_x=np.array([np.inf, 0.6]))
    single = shoot(limited, np.zeros(2), None, STILL[1], method="single").plan
    assert single.converged and worst_violation(limited, single) == "all constraints hold within 1e-06"
    assert_allclose(single.u, at_most().plan.u, atol=1e-5)
    for solution in (shoot(limited, np.zeros(2), *STILL), at_most((1e2, 0.0))):
        assert solution.converged and solution.violation < 1e-7
        assert_allclose(solution.plan.u, at_most().plan.u, atol=1e-5)


def test_active_constraints_are_met_and_their_pressures_close_the_lagrangian():
    """The problem is convex, so that these conditions prove the optimum."""
    solution = at_most()
    x = solution.plan.x
    u = solution.plan.u
    prices = np.asarray(solution.multipliers)
    speed = np.asarray(x[1:, 1])
    assert solution.converged and speed.max() == pytest.approx(0.6, abs=1e-7) and (speed > 0.6 - 1e-6).sum() > 3
    pressure = np.asarray(solution.pressures)[1:]  # of x_1 to x_N
    assert (pressure >= 0).all()
    assert_allclose(pressure * (speed - 0.6), 0.0, atol=1e-7)
    # Derivatives of the Lagrangian by hand, from the dynamics' constant matrices.
    A = np.array([[1.0, DT], [0.0, 1.0]])
    B = np.array([DT**2 / 2, DT])
    assert_allclose(2 * DT * u[:, 0] + prices @ B, 0.0, atol=1e-6)
    between = prices[1:] @ A - prices[:-1]
    between[:, 1] += pressure[:-1]
    assert_allclose(between, 0.0, atol=1e-6)


def test_a_soft_constraint_gives_way_where_its_price_is_low():
    """A mass that should not pass 0.5 m but is drawn to 1 m: w_1 + w_2 t is the marginal cost of the excess t."""
    drawn = BLOCK._replace(cost=lambda x, u: 1e-9 * u @ u, final_cost=lambda x: 10 * (x[0] - 1.0) ** 2)
    problem = drawn._replace(end=lambda x: x[1:], end_below=lambda x: x[:1] - 0.5, soft=(2.0, 4.0))
    solution = shoot(problem, np.zeros(2), *STILL)
    # 20 (1 - x) = 2 + 4 (x - 1/2)
    assert int(solution.ending) == Ending.EXCEEDED and solution.plan.x[-1, 0] == pytest.approx(20 / 24, abs=1e-5)
    assert solution.violation == pytest.approx(20 / 24 - 0.5, abs=1e-5)


def test_limits_come_from_a_robot():
    limits = {
        "position_limits": np.array([[-1.0, 2.0]]),
        "velocity_limits": 3.0,
        "force_limits": np.array([[-5.0, 6.0]]),
    }
    problem = with_limits_of(BLOCK, SimpleNamespace(**limits))
    expected = {"lower": [-5.0], "upper": [6.0], "lower_x": [-1.0, -3.0], "upper_x": [2.0, 3.0]}
    for name, values in expected.items():
        assert_array_equal(getattr(problem, name), values)


def test_a_start_outside_limits_and_crossed_limits_are_refused():
    for change, message in (
        ({"upper_x": np.array([0.5, np.inf])}, "violates the upper limit of state 0 at knot 0 by 0.5"),
        ({"states": lambda x: x[:1] - 0.25}, "violates constraint 0 on the states at knot 0 by 0.75"),
        ({"lower": 1.0, "upper": -1.0}, r"limits \[0\] of the controls are not in order; expected lower < upper"),
    ):
        with one_line(message):
            shoot(BLOCK._replace(**change), np.array([1.0, 0.0]), *STILL)
