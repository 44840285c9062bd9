"""After a push that throws a pendulum down, repeated plans bring it up again; a small one is left to the regulator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import TrajectoryProblem, first_plan, integrated, lqr, recovery_by_plans, regulated, value
from dln_jax.types import InputError

RATE, EVERY, STEPS, LIMIT = 100.0, 5, 40, 4.0
UPRIGHT, JOINTS = np.zeros(2), ("revolute",)


def rates(x, u):
    return jnp.stack([x[1], 9.81 * jnp.sin(x[0]) + u[0]])


def controller():
    """For a pendulum of 1 kg m² whose motor holds it up to 0.42 rad from upright; the parameter is its strength."""
    regulator = lqr([[0, 1], [9.81, 0]], [[0], [1]], np.diag([10.0, 1.0]), np.eye(1))
    dt = EVERY / RATE
    step = integrated(rates, dt)
    problem = TrajectoryProblem(
        step,
        lambda x, u: dt * (2 * (1 - jnp.cos(x[0])) + 0.01 * x[1] ** 2 + 0.02 * u @ u),
        lambda x: 40 * (1 - jnp.cos(x[0])) + 2 * x[1] ** 2,
        -LIMIT,
        LIMIT,
    )
    guesses = np.array([0.0, 3.0, -3.0])[:, None, None] * np.sin(3 * dt * np.arange(STEPS))[:, None]
    plans = jax.jit(jax.vmap(lambda u: first_plan(problem, UPRIGHT, u)))(guesses)
    near, cost = regulated(regulator, UPRIGHT, np.zeros(1), JOINTS), value(regulator, UPRIGHT, JOINTS)
    level = float(LIMIT**2 / (regulator.K @ np.linalg.solve(regulator.S, regulator.K.T)).item())
    return recovery_by_plans(
        lambda strength: problem._replace(step=lambda x, u: step(x, strength * u)), plans,
        lambda x, strength: near(x) / strength, lambda x, strength: cost(x), level, rate=RATE, every=EVERY,
        parameters=jnp.asarray(1.0),
    )  # fmt: skip


@pytest.fixture(scope="module")
def pushed():
    """(state after a push, strength of the motor) -> states, torques, whether the regulator acts, and last memory."""
    law = controller()

    def run(x, strength):
        step = integrated(lambda x, u: rates(x, strength * u), 1 / RATE)

        def sample(carry, number):
            x, memory = carry
            memory, u = law.act(memory, number / RATE, x)
            return (step(x, jnp.clip(u, -LIMIT, LIMIT)), memory), (x, u, memory.near)

        start = x, law.start._replace(parameters=strength)
        (_, memory), rows = jax.lax.scan(sample, start, jnp.arange(600))
        return *rows, memory

    compiled = jax.jit(run)
    return lambda x, strength=1.0: compiled(jnp.asarray(x, float), jnp.asarray(strength))


@pytest.mark.slow
@pytest.mark.parametrize("start", [(0.0, 3.0), (0.0, -5.0), (np.pi, 0.1)])
def test_a_pendulum_that_a_push_throws_down_comes_up_again_within_the_limits(pushed, start):
    x, u, near = map(np.asarray, pushed(start)[:3])
    assert np.cos(x[:, 0]).min() < -0.9 and not near[0]
    assert np.abs(np.sin(x[-100:, 0] / 2)).max() < 0.01 and near[-100:].all()
    assert np.abs(u[~near]).max() <= LIMIT


@pytest.mark.slow
def test_a_push_that_the_regulator_holds_is_not_replanned(pushed):
    x, _, near, memory = pushed([0.05, 0.3])
    assert near.all() and np.abs(x[:, 0]).max() < 0.3 and np.abs(x[-1]).max() < 1e-3
    np.testing.assert_array_equal(memory.plans.x[:, 0], 0.0)  # still those from upright


@pytest.mark.slow
def test_parameters_of_the_memory_change_the_plans(pushed):
    """Told that the motor has 0.7 times its strength, plans and regulator still bring the pendulum up with it."""
    x, _, _, _ = pushed([0.0, 3.0], strength=0.7)
    assert np.abs(np.sin(x[-100:, 0] / 2)).max() < 0.01


@pytest.mark.slow
def test_a_state_that_is_not_finite_has_no_torque(pushed):
    assert np.isnan(pushed([np.nan, 0.0])[1]).all()


@pytest.mark.slow
@pytest.mark.parametrize(("start", "near"), [((0.0, 3.0), False), ((0.05, 0.0), True)])
def test_a_reading_that_is_not_finite_costs_one_torque(start, near):
    law = controller()
    act, step, memory, x = jax.jit(law.act), jax.jit(integrated(rates, 1 / RATE)), law.start, jnp.asarray(start)
    memory = memory._replace(parameters=jnp.asarray(1.0))
    for number in range(21):
        lost = number in (5, 12)
        memory, u = act(memory, jnp.asarray(number / RATE), x * np.nan if lost else x)
        assert np.isnan(u).all() == lost and memory.near == near
        x = step(x, jnp.zeros(1) if lost else u)


def test_a_step_without_samples_is_refused():
    plans = first_plan(TrajectoryProblem(rates, lambda x, u: x @ x, lambda x: x @ x), UPRIGHT, np.zeros((1, 1)))
    with pytest.raises(InputError, match="every"):
        recovery_by_plans(None, plans, rates, rates, 1.0, rate=RATE, every=0)
