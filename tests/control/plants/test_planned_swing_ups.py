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


def rail(control):
    return layout(
        ("prismatic", "revolute"), [0], goal=(0, 0), hanging=(0, np.pi), rate=100.0, control=control,
        position=[[-0.6, 0.6], [-np.inf, np.inf]],
    )  # fmt: skip


def scaled(plant):
    upright = upright_of(MODEL, plant.actuation, plant.goal, postures=circle(plant))
    return upright, scales_of(upright, plant)


@pytest.fixture(scope="module")
def planned():
    plant = rail(8.0)
    upright, scales = scaled(plant)
    plan = plans_of(upright, plant, scales)[0]
    (one,) = followed([plan], upright, plant, scales, [USUAL], spread_of(plant))
    settings, _ = swing_up_numbers(upright, plant, scales, USUAL)
    return plant, upright, plan, one, follower(upright, plant, settings, one)


def simulated(planned, start):
    _, upright, _, _, controller = planned
    hardware = Hardware(-8.0, 8.0)
    run = jax.jit(
        lambda x: simulate(
            field_of(upright.model, upright.B), controller, x, seconds=6.0, rate=100.0, controls=1, hardware=hardware
        )
    )
    return run(jnp.asarray(start, float))


@pytest.mark.slow
def test_a_plan_arrives_within_its_share_of_the_limits(planned):
    _, upright, plan, _, _ = planned
    assert np.abs(plan.u).max() <= SHARE * 8.0 + 1e-9
    assert np.abs(plan.x[:, 0]).max() <= INSIDE * 0.6 + 0.05
    np.testing.assert_allclose(plan.x[-1][:2], upright.at.x[:2], atol=0.03)


@pytest.mark.slow
def test_the_feedback_s_cost_to_go_at_the_end_is_the_regulator_s(planned):
    _, _, _, one, _ = planned
    # One step before the end the gains differ from the regulator's by a sample.
    np.testing.assert_allclose(one.K[-1], one.goal.K, rtol=0.35)
    assert np.linalg.eigvalsh(one.S).min() > 0


@pytest.mark.slow
def test_a_plant_that_was_not_at_rest_hangs_first_and_then_swings_up(planned):
    for start in ([0.0, np.pi + 0.1, 0.0, 0.0], [0.1, np.pi - 1.0, 0.0, 3.0]):
        run = simulated(planned, start)
        assert np.abs(np.remainder(run.x[-100:, 1] + np.pi, 2 * np.pi) - np.pi).max() < 0.05
        assert np.abs(run.x[:, 0]).max() < 0.6


@pytest.mark.slow
def test_repeated_plans_swing_up_and_recover_within_the_rail():
    plant = rail(8.0)
    upright, scales = scaled(plant)
    settings, regulator = swing_up_numbers(upright, plant, scales, USUAL)
    controller = recovering(upright, plant, scales, settings, regulator, settings.level)
    push = Push(3.0, [0.0, 12.0])  # upright again after 1 to 2.8 s, by which turn of the pole is planned first
    run = jax.jit(
        lambda x: simulate(
            field_of(MODEL, plant.actuation), controller, x, seconds=7.0, rate=100.0, controls=1,
            hardware=Hardware(-8.0, 8.0), push=push,
        )
    )(jnp.array([0.0, np.pi + 0.1, 0.0, 0.0]))  # fmt: skip
    away = np.abs(np.remainder(run.x[:, 1] + np.pi, 2 * np.pi) - np.pi)
    assert away[250:300].max() < 0.05 and away[300:450].max() > 2 and away[-50:].max() < 0.05
    assert np.abs(run.x[:, 0]).max() < 0.6
