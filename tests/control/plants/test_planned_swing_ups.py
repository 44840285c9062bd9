"""Plans lead from hanging to the goal within their limits, and their feedback ends in the goal's regulator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control.closed_loop import Hardware, Push, simulate
from dln_jax.control.plants import layout
from dln_jax.control.plants.planned import INSIDE, SHARE, followed, follower, plans_of
from dln_jax.control.plants.recovery import recovering
from dln_jax.control.plants.scales import USUAL, circle, scales_of, swing_up_numbers
from dln_jax.control.plants.simulated import spread_of
from dln_jax.control.state_space import field_of
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
    position=[[-0.6, 0.6], [-np.inf, np.inf]],
)


@pytest.fixture(scope="module")
def scaled():
    upright = upright_of(MODEL, RAIL.actuation, RAIL.goal, postures=circle(RAIL))
    scales = scales_of(upright, RAIL)
    return upright, scales, *swing_up_numbers(upright, RAIL, scales, USUAL)


def away_from_the_goal(controller, starts, push=None):
    """Angles of the pole from upright along 7 s from each start; asserts that the cart stays on its rail."""
    settings = {"seconds": 7.0, "rate": 100.0, "controls": 1, "hardware": Hardware(-8.0, 8.0), "push": push}
    run = jax.jit(lambda x: simulate(field_of(MODEL, RAIL.actuation), controller, x, **settings).x)
    for start in starts:
        x = run(jnp.asarray(start, float))
        assert np.abs(x[:, 0]).max() < 0.6
        yield np.abs(np.remainder(x[:, 1] + np.pi, 2 * np.pi) - np.pi)


@pytest.mark.slow
def test_plan_arrives_within_its_limits_and_its_feedback_swings_up_plants_that_hang_first(scaled):
    upright, scales, settings, _ = scaled
    plan = plans_of(upright, RAIL, scales)[0]
    assert np.abs(plan.u).max() <= SHARE * 8.0 + 1e-9
    assert np.abs(plan.x[:, 0]).max() <= INSIDE * 0.6 + 0.05
    np.testing.assert_allclose(plan.x[-1][:2], upright.at.x[:2], atol=0.03)
    (one,) = followed([plan], upright, RAIL, scales, [USUAL], spread_of(RAIL))
    # One step before the end the gains differ from the regulator's by a sample.
    np.testing.assert_allclose(one.K[-1], one.goal.K, rtol=0.35)
    assert np.linalg.eigvalsh(one.S).min() > 0
    starts = [0.0, np.pi + 0.1, 0.0, 0.0], [0.1, np.pi - 1.0, 0.0, 3.0]
    for away in away_from_the_goal(follower(upright, RAIL, settings, one), starts):
        assert away[-100:].max() < 0.05


@pytest.mark.slow
def test_repeated_plans_swing_up_and_recover_within_the_rail(scaled):
    upright, scales, settings, regulator = scaled
    controller = recovering(upright, RAIL, scales, settings, regulator, settings.level)
    push = Push(3.0, [0.0, 12.0])  # upright again after 1 to 2.8 s, by which turn of the pole is planned first
    (away,) = away_from_the_goal(controller, [[0.0, np.pi + 0.1, 0.0, 0.0]], push)
    assert away[250:300].max() < 0.05 and away[300:450].max() > 2 and away[-50:].max() < 0.05
