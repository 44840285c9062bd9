"""The environment passes Gymnasium's checks, is the closed loop of `simulate`, and says when it fails."""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dln_jax.control import Controller, Hardware, field_of, simulate
from dln_jax.control.environment import PlantEnvironment, register
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.poles import cart_pole
from dln_jax.types import InputError

SCENE = cart_pole()
FIELD = field_of(dynamics(SCENE.energies), np.asarray(SCENE.needs.actuation))
LAB = Hardware(-4.0, 6.0, encoder_step=1e-3, delay=1)


def cost(x, u):
    return x[0] ** 2 + 1 - jnp.cos(x[1]) + 0.01 * u @ u


def hanging(key):
    return jnp.array([0.0, jnp.pi, 0.0, 0.0]) + 0.01 * jax.random.normal(key, (4,))


def environment(field=FIELD):
    return PlantEnvironment(field, cost, hanging, SCENE.needs.joints, seconds=0.2, rate=50.0, hardware=LAB)


@functools.cache
def checked():
    return environment()


def test_it_passes_gymnasiums_checks():
    check_env(checked(), skip_render_check=True)
    register("dln_jax/CartPole-v0", environment)
    register("dln_jax/CartPole-v0", environment)
    assert isinstance(gymnasium.spec("dln_jax/CartPole-v0").make().unwrapped, PlantEnvironment)


def test_an_episode_is_a_closed_loop():
    env = checked()
    actions = np.linspace(-1, 1, 10, dtype=np.float32)[:, None]
    _, info = env.reset(seed=3)
    start, steps = info["x"], [env.step(action) for action in actions]
    law = Controller(
        jnp.asarray(0), lambda number, t, y: (number + 1, 1.0 + 5.0 * jnp.asarray(actions.astype(float))[number])
    )
    run = simulate(FIELD, law, start, seconds=0.2, rate=50.0, controls=1, hardware=LAB)
    np.testing.assert_allclose([step[4]["x"] for step in steps], run.x[1:], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(
        [step[1] for step in steps], [-cost(*each) / 50 for each in zip(run.x, run.u, strict=False)]
    )
    assert [step[3] for step in steps] == [False] * 9 + [True] and not any(step[2] for step in steps)
    seen, q = steps[-2][0], np.round(run.x[-2, :2], 3)
    np.testing.assert_allclose(seen, [q[0], np.cos(q[1]), np.sin(q[1]), *run.x[-2, 2:]], rtol=1e-5)
    assert (env.reset(seed=3)[1]["x"] == start).all() and (env.reset()[1]["x"] != start).any()


def test_a_failure_is_one():
    env = environment(lambda x, u: jnp.where(x[0] > -jnp.inf, jnp.nan, x))
    first, _ = env.reset(seed=0)
    seen, reward, terminated, truncated, info = env.step(np.zeros(1, np.float32))
    assert terminated and not truncated and info["failed"] and reward == -1e3
    np.testing.assert_array_equal(seen, first)


def test_mistakes_are_one_line():
    with pytest.raises(InputError, match="expected finite ones"):
        PlantEnvironment(FIELD, cost, hanging, SCENE.needs.joints, seconds=1.0, rate=50.0, hardware=Hardware())
    with pytest.raises(InputError, match="call reset before step"):
        environment().step(np.zeros(1, np.float32))
