"""The rival by stable-baselines3: its actor as a policy, and its lanes as single environments."""

import importlib.util
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import refused
from jax.sharding import Mesh
from small_creature import EPISODE, block_task

from dln_jax.locomotion.environment import CreatureEnvironment
from dln_jax.locomotion.task import actuation_seen
from dln_jax.scale.mesh import AXIS
from scripts.reports.commands import compare_locomotion
from scripts.reports.locomotion.ppo import make_actor


@pytest.fixture(scope="module")
def task():
    return block_task()


@pytest.fixture(scope="module")
def environment(task):
    return CreatureEnvironment(task)


def test_the_actor_is_the_network_of_tanh_layers(task):
    random = np.random.default_rng(0)
    sizes = (task.observation_size, 4, 4, 2)
    layers = tuple(
        {"w": random.normal(size=(m, n)).astype(np.float32), "b": random.normal(size=m).astype(np.float32)}
        for n, m in itertools.pairwise(sizes)
    )
    seen = random.normal(size=sizes[0])
    h = np.tanh(layers[1]["w"] @ np.tanh(layers[0]["w"] @ seen + layers[0]["b"]) + layers[1]["b"])
    target = 0.625 + 0.375 * np.clip(layers[2]["w"] @ h + layers[2]["b"], -1, 1)
    expected = 0.3 * np.tanh((target - actuation_seen(task, jnp.asarray(seen))) / 0.3)
    np.testing.assert_allclose(make_actor(task).apply(layers, jnp.asarray(seen)), expected, rtol=1e-5)


@pytest.mark.parametrize("shared", [False, True])
def test_vector_lanes_are_single_environments(task, environment, shared):
    pytest.importorskip("stable_baselines3", reason="PPO needs the extra [rl]")
    from scripts.reports.locomotion.vector_environment import VectorEnvironment

    # One device shares them with nobody, by the program of several.
    mesh = Mesh(np.array(jax.devices()[:1]), (AXIS,)) if shared else None
    lanes = VectorEnvironment(task, 2, reward_scale=10.0, mesh=mesh)
    random = np.random.default_rng(1)
    single, _ = environment.reset(seed=0)
    np.testing.assert_array_equal(lanes.reset()[1], single)
    for _ in range(EPISODE):
        actions = random.uniform(-1, 1, (2, 2)).astype(np.float32)
        seen, rewards, done, infos = lanes.step(actions)
        single, reward, *_ = environment.step(actions[1])
        np.testing.assert_allclose(rewards[1], 10.0 * reward, rtol=1e-4, atol=1e-6)
    assert done.all() and infos[1]["TimeLimit.truncated"]
    np.testing.assert_allclose(infos[1]["terminal_observation"], single, rtol=1e-3, atol=1e-5)
    np.testing.assert_array_equal(seen, lanes.reset())


def test_missing_rivals_are_one_line(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "pip install 'dln-jax[rl]'" in refused(capsys, compare_locomotion, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()
