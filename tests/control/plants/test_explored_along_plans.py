"""Explorations follow a plan where no energy law came near the goal, and a lost plan starts again nearer to rest."""

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.plants import Exploration, explore, exploring, layout, plant_of
from dln_jax.control.plants.planned import CALM, PATIENCE, READY, Followed, follower
from dln_jax.control.plants.runs import distances
from dln_jax.control.plants.scales import USUAL, circle, scales_of, swing_up_numbers
from dln_jax.control.regulators import Regulator
from dln_jax.control.swing_up import upright_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.poles import cart_pole

MODEL = dynamics(cart_pole(cart_mass=0.6, pole_mass=0.15, length=0.25, friction=0.002).closed_form)
RAIL = layout(
    ("prismatic", "revolute"),
    [0],
    goal=(0, 0),
    hanging=(0, np.pi),
    rate=100.0,
    control=8.0,
    position=[[-0.8, 0.8], [-np.inf, np.inf]],
)
LOW = (-0.9, -0.9, -0.9, -0.9)
"""Surpluses of energy laws that stay far below the goal."""


@pytest.mark.slow
def test_episodes_follow_a_plan_where_none_came_near_the_goal():
    plant, exploration = (
        plant_of(MODEL, RAIL, hardware=Hardware(encoder_step=1e-4)),
        Exploration(seconds=15.0, surplus=LOW),
    )
    recording = explore(plant, lambda _: MODEL, exploration).recording
    near = [distances(recording.q[recording.trajectory == k], RAIL).min() < exploring.NEAR for k in range(6)]
    assert near == [False] * 4 + [True] * 2
    assert np.abs(recording.tau[:, 0]).max() <= exploration.share * 8.0 + 1e-12


def test_a_lost_plan_starts_again_nearer_to_rest_or_after_a_while():
    upright = upright_of(MODEL, RAIL.actuation, RAIL.goal, postures=circle(RAIL))
    settings, goal = swing_up_numbers(upright, RAIL, scales_of(upright, RAIL), USUAL)
    rest, samples = jnp.array([0.0, np.pi, 0.0, 0.0]), 10
    zeros = jnp.zeros((samples, 1))
    regulator = Regulator(jnp.zeros((1, 4)), jnp.eye(4))
    gains = jnp.zeros((samples, 1, 4))
    plan = Followed(jnp.tile(rest, (samples, 1)), zeros, gains, jnp.eye(4), 0.09, goal, regulator)
    act = follower(upright, RAIL, settings, plan).act

    def start(number, off):
        return int(act(jnp.asarray(number), jnp.zeros(()), rest.at[1].add(off))[0])

    assert start(READY, 0.29) == 1 and start(READY, 0.31) == READY
    lost = start(5, 1.1)
    assert lost == READY - PATIENCE * samples + 1
    assert start(lost, 0.99 * 0.3 * np.sqrt(CALM)) == 1 and start(lost, 1.01 * 0.3 * np.sqrt(CALM)) == lost + 1
    assert start(READY - 1, 0.29) == READY and start(READY, 0.29) == 1
