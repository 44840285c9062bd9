"""Gains come from the scales of a model and from trials, and a plant that none of them swings up is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose

from dln_jax.control.closed_loop import Hardware, simulate, stateless
from dln_jax.control.plants.exploring import NEAR, Exploration, explore
from dln_jax.control.plants.planned import by_repeated_plans, inner_ranges
from dln_jax.control.plants.plant import layout, plant_of
from dln_jax.control.plants.runs import compiled, distances, judged_runs, run, start_of
from dln_jax.control.plants.tuning import trial_of, tune
from dln_jax.control.state_space import field_of
from dln_jax.control.swing_up import USUAL, swing_up_numbers, upright_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import cart_pole

SIZES = {"cart_mass": 0.6, "pole_mass": 0.15, "length": 0.25}


def rail(control=8.0):
    limits = [[-0.8, 0.8], [-np.inf, np.inf]]
    postures = {"goal": (0, 0), "hanging": (0, np.pi)}
    return layout(("prismatic", "revolute"), [0], **postures, rate=100.0, control=control, position=limits)


def model(**sizes):
    return dynamics(cart_pole(**{**SIZES, **sizes}, friction=0.002).closed_form)


def scaled(plant, **sizes):
    return upright_of(model(**sizes), plant)


def test_scales_of_a_cart_pole_have_closed_forms():
    plant = rail()
    scales = scaled(plant).scales
    m, l, g = SIZES["pole_mass"], SIZES["length"], 9.81
    assert scales.fall == pytest.approx(np.sqrt(g / l))
    assert scales.energy == pytest.approx(2 * m * g * l, rel=1e-6)
    assert scales.speed == pytest.approx(2 * np.sqrt(g / l), rel=1e-6)
    assert scales.coupling == pytest.approx(m * l)
    assert scales.acceleration == pytest.approx(8.0 / SIZES["cart_mass"])
    assert_allclose(scales.sizes, [l, 1.0])
    with one_line("do not fall from the goal"):
        scaled(plant._replace(goal=plant.hanging, hanging=plant.goal))


def test_similar_plants_get_the_same_law_in_their_own_units():
    """Masses and forces 3 times as large leave accelerations, and the regulator's feedback grows as the force."""
    large = rail(24.0)
    one = swing_up_numbers(scaled(rail()), USUAL)
    other = swing_up_numbers(scaled(large, cart_mass=1.8, pole_mass=0.45), USUAL)
    assert_allclose(other.regulator.K, 3 * np.asarray(one.regulator.K), rtol=1e-6)
    assert other.level == pytest.approx(one.level, rel=1e-6) and other.kick == pytest.approx(3 * one.kick)
    # k E M_ap qd_p is an acceleration, where E and M_ap grow by 3 each.
    assert other.gains.energy == pytest.approx(one.gains.energy / 9, rel=1e-6)
    assert_allclose(other.gains[1:3], one.gains[1:3], rtol=1e-6)


def test_a_share_of_a_range_is_its_middle():
    limits = rail().limits._replace(position=np.array([[1.0, 2.0], [-np.inf, 3.0]]))
    assert_allclose(inner_ranges(rail()._replace(limits=limits), 0.8), [[1.1, -np.inf], [1.9, 3.0]])


def test_on_the_surface_of_the_catch_region_the_regulator_asks_for_the_motors_limit():
    numbers = swing_up_numbers(scaled(rail()), {**USUAL, "catch": 1.0})
    regulator = numbers.regulator
    directions = np.random.default_rng(0).normal(size=(20000, 4)) @ np.linalg.inv(np.linalg.cholesky(regulator.S))
    sizes = np.sqrt(np.einsum("ni,ij,nj->n", directions, regulator.S, directions))
    asked = np.abs((np.sqrt(numbers.level) * directions / sizes[:, None]) @ np.asarray(regulator.K).T).max()
    assert 0.97 * 8.0 < asked <= 8.0 + 1e-9


def test_trials_of_a_model_choose_a_law_that_swings_the_plant_up():
    plant = rail()
    lab = Hardware(encoder_step=1e-4, delay=1)
    tuned = tune(model(), plant, lab, sets=32, seconds=6.0)
    assert 0 < tuned.worked <= 1 and tuned.margin >= 0 and tuned.trials >= 64
    plants = [plant_of(model(), plant, hardware=lab, seed=seed) for seed in range(4)]
    act = compiled(tuned.controller, plant)
    trials = judged_runs(run(plants, act, start_of(tuned.controller, 4), seconds=6.0), plant, seconds=6.0)
    assert trials.up.all() and not trials.stopped


def test_episodes_of_an_exploration_follow_a_plan_where_none_came_near_the_goal():
    plant = plant_of(model(), rail(), hardware=Hardware(encoder_step=1e-4))
    low = (-0.9, -0.9, -0.9, -0.9)
    recording = explore(plant, lambda _: model(), Exploration(seconds=15.0, surplus=low)).recording
    near = [distances(recording.q[recording.trajectory == k], rail()).min() < NEAR for k in range(6)]
    assert near == [False] * 4 + [True] * 2
    assert np.abs(recording.tau[:, 0]).max() <= Exploration().share * 8.0 + 1e-12


@pytest.mark.slow
def test_repeated_plans_swing_up_within_the_rail():
    plant = rail()
    upright = scaled(plant)
    law = by_repeated_plans(upright, swing_up_numbers(upright, USUAL))
    field, motors = field_of(model(), plant.actuation), Hardware(-8.0, 8.0)
    start = jnp.array([0.0, np.pi + 0.1, 0.0, 0.0])
    x = jax.jit(lambda: simulate(field, law, start, seconds=3.0, rate=100.0, controls=1, hardware=motors).x)()
    assert np.cos(x[-100:, 1]).min() > np.cos(0.05) and np.abs(x[:, 0]).max() < 0.8


def trial(law, plant, hardware, late=0.0):
    return trial_of(lambda _: stateless(law), model(), plant, hardware, seconds=2.0, late=late)


def test_motors_a_whole_sample_late_are_hardware_with_that_delay():
    def margin(delay, late):
        law = lambda x: 3.0 * jnp.cos(5 * x[:1] + x[1:2])  # noqa: E731
        made = trial(law, rail(), Hardware(delay=delay, encoder_noise=1e-4), late)
        return float(made((), jnp.array([0.0, 0.1]), jnp.array(0.0), jax.random.key(0))[1])

    delayed = margin(1, 0.0)
    assert margin(0, 1.0) == pytest.approx(delayed, rel=1e-9)
    assert abs(margin(0, 0.5) / delayed - 1) > 1e-6


@pytest.mark.slow
def test_trial_fails_where_noise_makes_a_plant_look_faster_than_its_limit():
    """A plant at rest at its goal, for which rates over five samples have the standard deviation 28 noise."""
    still = rail()
    still = still._replace(limits=still.limits._replace(rate=np.array([0.2, 0.2])))
    for noise, fine in ((1e-3, True), (1e-2, False)):
        made = trial(lambda x: jnp.zeros(1), still, Hardware(encoder_noise=noise))
        seconds, _ = made((), jnp.asarray(still.goal), jnp.array(0.0), jax.random.key(0))
        assert np.isfinite(seconds) == fine
