"""The published plants are as printed, and the library's files of the same names move alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.commands.values import plants
from dln_jax.control.optimal.own_plants import FOLDER
from dln_jax.control.optimal.problem import rates
from dln_jax.zoo.value_functions import plant_of_model
from scripts.reports.control.published import PLANTS, evaluate, starts


def test_the_pendulum_as_printed():
    plant = PLANTS["pendulum"]()
    x, u = jnp.array([0.7, -1.3]), jnp.array([1.1])
    np.testing.assert_allclose(
        jax.jit(rates(plant.problem))(x, u), [-1.3, 3 * (1.1 + 9.81 / 2 * np.sin(0.7))], rtol=1e-12
    )
    assert jax.jit(plant.problem.state_cost)(x) == pytest.approx((np.pi * np.sin(0.35)) ** 2 + 0.1 * 1.3**2)
    assert plant.problem.discount == pytest.approx(-np.log(0.65) / 5)


def test_the_cart_pole_as_printed():
    problem = PLANTS["cart-pole"]().problem
    x, u = jnp.array([0.1, 2.0, 0.5, -3.0]), jnp.array([4.0])
    m, l, total = 0.127, 0.16825, 0.57 + 0.127
    M = np.array([[total, m * l * np.cos(2.0)], [m * l * np.cos(2.0), m * l**2]])
    bias = np.array([-m * l * np.sin(2.0) * 9.0, -m * l * 9.81 * np.sin(2.0)])
    expected = np.linalg.solve(M, np.array([4.0 - 0.1 * 0.5, 1e-3 * 3.0]) - bias)
    np.testing.assert_allclose(jax.jit(rates(problem))(x, u)[2:], expected, rtol=1e-12)
    inside, outside = map(float, jax.jit(jax.vmap(problem.state_cost))(jnp.array([[0.3, 0, 0, 0], [0.5, 0, 0, 0]])))
    wall = 5 * 25 * 0.4**2 / (1 + np.exp(-20 * (0.5 - 0.4)))
    assert outside == pytest.approx(25 * 0.25 + wall, abs=0.01) and inside == pytest.approx(25 * 0.09 + 2.4, abs=0.05)


@pytest.mark.parametrize("name", PLANTS)
def test_files_have_the_published_dynamics(name):
    run, known, _ = plants.of_file(FOLDER / f"{name}.xml")
    of_file = plant_of_model(run.model, run.parameters, plants.problem_of(run, known))
    x, u = jnp.array([0.3, 2.0, -1.5, 4.0])[-2 * len(known.joints) :], 0.7 * known.limits.control[:, 1]
    published = PLANTS[name]()
    assert known.limits.control[0, 1] == published.limit
    np.testing.assert_allclose(rates(of_file)(x, u), rates(published.problem)(x, u), rtol=1e-9)


def test_returns_of_rest_and_of_a_law_that_fails():
    plant = PLANTS["pendulum"]()
    hanging = np.array([[np.pi, 0.0]])
    found = evaluate(plant, lambda x: jnp.zeros(1), hanging)
    assert found.returns[0] == pytest.approx(-5 * np.pi**2) and np.isinf(found.settled[0])
    failed = evaluate(plant, lambda x: jnp.full(1, jnp.nan), hanging)
    assert np.isnan(failed.returns[0]) and np.isinf(failed.settled[0])
    assert np.abs(starts(plant, "down")[:, 0] - np.pi).max() < 0.2 and len(starts(plant, "uniform", 7)) == 7
