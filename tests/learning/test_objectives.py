"""Inverse and forward errors together, as Lutter and Peters (2021) fit them, for every model that has an energy."""

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.data.splits import split
from dln_jax.learning.dynamics import problem
from dln_jax.learning.engine.problem import arrays_of, loss_of
from dln_jax.learning.objectives import BOTH_WAYS, STATED, objective_of, residuals
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.datasets.generators import uniform
from dln_jax.scenes.pendulums import cart_pole
from dln_jax.zoo.descriptions import build, describe_for

ENERGIES = ("structured-delan", "black-box-hnn", "trigonometric")
"""Records with a closed form of both sides, with a Legendre transform, and with explicit forces."""
SMALL = {"width": 3, "depth": 1, "activation": "tanh"}


@pytest.fixture(scope="module")
def data():
    """States of a cart-pole, whose mass matrix couples two joints with friction."""
    return uniform(cart_pole(friction=0.3), samples=60, rate_bound=2.0, acceleration_bound=5.0)


def model_of(name, data):
    size = {"degree": 1} if name == "trigonometric" else SMALL
    return build(describe_for(name, data, data.needs, precision="f64", **size))


@pytest.mark.parametrize("objective", STATED)
def test_residuals_vanish_for_the_true_plant(data, objective):
    found = residuals(STATED[objective], cart_pole(friction=0.3).energies, arrays_of(data, STATED[objective].keys))
    assert found.shape == (60, 4 if objective == "both" else 2)
    assert float(jnp.abs(found).max()) < 1e-10


@pytest.mark.parametrize("name", ENERGIES)
def test_each_side_is_measured_in_its_standard_deviation(name, data):
    model, sets = model_of(name, data), split(data)
    posed, train = problem(model, sets, BOTH_WAYS), sets.train

    @jax.jit
    def ask(parameters):
        plant = dynamics(model.energies(parameters))
        sides = jax.vmap(lambda q, qd, x, tau: (plant.inverse_dynamics(q, qd, x), plant.forward_dynamics(q, qd, tau)))
        return loss_of(posed)(parameters, posed.arrays), *sides(train.q, train.qd, train.qdd, train.tau)

    loss, torque, acceleration = ask(posed.parameters)
    # Only the cart is driven: the pole's torque, which is zero, counts in units of the cart's.
    expected = np.sum(((torque - train.tau) / train.tau[:, 0].std()) ** 2, axis=1).mean()
    expected += np.sum(((acceleration - train.qdd) / train.qdd.std(axis=0)) ** 2, axis=1).mean()
    np.testing.assert_allclose(loss, expected, rtol=1e-9)


def test_only_an_energy_can_be_fitted_by_one_of_two_sides(data):
    assert objective_of("structured-hnn", data, "both") is BOTH_WAYS
    assert objective_of("feed-forward", data, "both") is objective_of("feed-forward", data) is BOTH_WAYS
    with one_line("feed-forward model has no energy"):
        objective_of("feed-forward", data, "inverse")
