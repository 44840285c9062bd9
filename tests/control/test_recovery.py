"""After a push that throws a pendulum down, repeated plans bring it up again; a small one is left to the regulator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.control.recovery import recovery_by_plans
from dln_jax.control.regulators import lqr, regulated, value
from dln_jax.control.state_space import integrated
from dln_jax.control.trajectories import TrajectoryProblem, first_plan

RATE, EVERY, STEPS, LIMIT = 100.0, 5, 40, 4.0
UPRIGHT, JOINTS = np.zeros(2), ("revolute",)


def rates(x, u):
    return jnp.stack([x[1], 9.81 * jnp.sin(x[0]) + u[0]])


def controller():
    """For a pendulum of 1 kg m² whose motor holds it up to 0.42 rad from upright; the parameter is its strength."""
    regulator = lqr([[0, 1], [9.81, 0]], [[0], [1]], np.diag([10.0, 1.0]), np.eye(1))
    K = np.asarray(regulator.K)[0]
    S = np.asarray(regulator.S)
    dt = EVERY / RATE
    step = integrated(rates, dt)
    cost = lambda x, u: dt * (2 * (1 - jnp.cos(x[0])) + 0.01 * x[1] ** 2 + 0.02 * u @ u)  # noqa: E731
    final = lambda x: 40 * (1 - jnp.cos(x[0])) + 2 * x[1] ** 2  # noqa: E731
    problem = TrajectoryProblem(step, cost, final, -LIMIT, LIMIT)
    guesses = np.array([0.0, 3.0, -3.0])[:, None, None] * np.sin(3 * dt * np.arange(STEPS))[:, None]
    near = regulated(regulator, UPRIGHT, np.zeros(1), JOINTS)
    to_go = value(regulator, UPRIGHT, JOINTS)
    return recovery_by_plans(
        lambda strength: problem._replace(step=lambda x, u: step(x, strength * u)),
        jax.jit(jax.vmap(lambda u: first_plan(problem, UPRIGHT, u)))(guesses),
        lambda x, strength: near(x) / strength,
        lambda x, strength: to_go(x),
        LIMIT**2 / (K @ np.linalg.solve(S, K)),
        rate=RATE,
        every=EVERY,
        parameters=jnp.asarray(1.0),
    )


@pytest.fixture(scope="module")
def pushed():
    """State after a push, strength of the motor and unread samples -> states, torques, and which are the regulator's.

    Asserts that torques are finite but at unread samples, and those of plans within the limits.
    """
    law = controller()

    @jax.jit
    def run(x, strength, unread):
        step = integrated(lambda x, u: rates(x, strength * u), 1 / RATE)

        def sample(carry, number):
            x, memory = carry
            lost = jnp.any(number == unread)
            memory, u = law.act(memory, number / RATE, jnp.where(lost, jnp.nan, x))
            moved = step(x, jnp.where(lost, 0.0, jnp.clip(u, -LIMIT, LIMIT)))
            return (moved, memory), (x, u[0], memory.near)

        start = x, law.start._replace(parameters=strength)
        (_, memory), rows = jax.lax.scan(sample, start, jnp.arange(600))
        return rows, memory.plans.x

    def checked(x, strength=1.0, unread=(-1, -1)):
        (x, u, near), plans = run(jnp.array(x, float), jnp.asarray(strength), jnp.array(unread))
        np.testing.assert_array_equal(np.isnan(u), np.isin(np.arange(600), unread))
        assert np.nanmax(np.abs(u[~near]), initial=0.0) <= LIMIT
        return x, near, plans

    return checked


def test_a_pendulum_that_a_push_throws_down_comes_up_again_within_the_limits(pushed):
    """Also with readings that are not finite, and told that its motor has 0.7 times its strength."""
    for start, settings in (
        ((0.0, 3.0), {}),
        ((0.0, -5.0), {"unread": (5, 12)}),
        ((np.pi, 0.1), {}),
        ((0.0, 3.0), {"strength": 0.7}),
    ):
        x, near, _ = pushed(start, **settings)
        assert np.cos(x[:, 0]).min() < -0.9 and not near[0]
        assert np.abs(np.sin(x[-100:, 0] / 2)).max() < 0.01 and near[-100:].all()


@pytest.mark.slow
def test_a_push_that_the_regulator_holds_is_not_replanned(pushed):
    x, near, plans = pushed([0.05, 0.3], unread=(5, 12))
    assert near.all() and np.abs(x[:, 0]).max() < 0.3 and np.abs(x[-1]).max() < 1e-3
    np.testing.assert_array_equal(plans[:, 0], 0.0)  # still those from upright


def test_a_step_without_samples_is_refused():
    plans = first_plan(TrajectoryProblem(rates, lambda x, u: x @ x, lambda x: x @ x), UPRIGHT, np.zeros((1, 1)))
    with one_line("every"):
        recovery_by_plans(None, plans, rates, rates, 1.0, rate=RATE, every=0)
