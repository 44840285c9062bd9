"""MuJoCo, which shares no equation with ours, gives the same closed loop, with the same hardware."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from calls import one_line

from dln_jax import tree_system
from dln_jax.control.closed_loop import Hardware, simulate, stateless
from dln_jax.control.plants.mujoco_plants import simulate_in_mujoco
from dln_jax.control.state_space import field_of
from dln_jax.data.robot_files import mjcf
from dln_jax.data.robots import Robot
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees.description import make_tree
from dln_jax.mechanics.trees.inertia import inertial_parameters

B = np.array([[1.0], [0.0]])
START = np.array([0.1, 0.5, 0.0, -0.3])
FREE = np.full((2, 2), [-np.inf, np.inf])


@functools.cache
def cart_pole():
    bodies = [inertial_parameters(1.0, np.zeros(3), np.eye(3)), inertial_parameters(0.1, [0, 0, 0.5], 1e-3 * np.eye(3))]
    still = np.tile(np.eye(3), (2, 1, 1))
    tree = make_tree([-1, 0], ["prismatic", "revolute"], still, np.zeros((2, 3)), [[1, 0, 0], [0, 1, 0]], bodies)
    return Robot(tree, np.zeros(2), np.zeros(2), FREE, FREE)


def model():
    return mujoco.MjModel.from_xml_string(mjcf(cart_pole(), time_step=0.002).replace("implicitfast", "RK4"))


LAW = stateless(lambda y: jnp.array([8.0 * y[1] + 2.0 * y[3] + y[0]]))
LAB = Hardware(-3.0, 2.0, encoder_step=1e-3, delay=2)


def test_both_plants_give_the_same_run():
    settings = {"seconds": 1.0, "rate": 100.0, "hardware": LAB}
    found = simulate_in_mujoco(model(), LAW, START, actuation=B, **settings)
    field = field_of(dynamics(tree_system(cart_pole().tree)), B)
    expected = jax.jit(lambda: simulate(field, LAW, START, controls=1, substeps=5, **settings))()
    for ours, theirs in zip(expected, found, strict=True):
        np.testing.assert_allclose(theirs, ours, atol=1e-7)
    u = np.asarray(found.u)
    assert (u[:2] == 0).all() and u[2] == 2.0 and u.min() >= -3.0 and u.max() <= 2.0
    np.testing.assert_allclose(found.y[:, :2], np.round(np.asarray(found.x[:-1, :2]), 3), atol=1e-12)


def test_a_control_that_is_not_finite_ends_the_run():
    bad = stateless(lambda y: jnp.where(y[:1] > 0.0999, jnp.nan, 1.0))
    run = simulate_in_mujoco(model(), bad, START, seconds=0.1, rate=100.0, actuation=B)
    assert np.isnan(run.x[1:]).all() and np.isnan(run.u[0]).all() and np.isfinite(run.x[0]).all()


def test_models_starts_and_rates_that_do_not_fit_are_refused():
    for given, start, rate, message in (
        ("<mujoco><worldbody><body/></mujoco>", START, 100.0, "MuJoCo refuses the model"),
        (model(), START[:3], 100.0, r"x has shape \(3,\) for 2 degrees"),
        (model(), START, 300.0, "a sample has 1.667 steps of 0.002 s"),
    ):
        with one_line(message):
            simulate_in_mujoco(given, LAW, start, seconds=0.1, rate=rate, actuation=B)
