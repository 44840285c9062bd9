"""Each law of friction by its formula, its integral and its derivatives; what is needed and nothing else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from calls import one_line

from dln_jax import joint_dissipation
from dln_jax.mechanics.dynamics import friction_force
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import (
    LAWS,
    POTENTIALS,
    FrictionShape,
    coefficients_of,
    require_laws,
    shape_of,
    unit_force,
)
from dln_jax.scenes.pendulums import two_link_arm

SHAPE = FrictionShape(velocity_scale=0.02, stribeck_velocity=0.3, sigmoid_slope=8.0, sigmoid_shift=-0.05)
V, W, SLOPE, SHIFT = SHAPE
RATES = np.array([-300.0, -2.0, -0.3, -0.021, -1e-9, 0.0, 1e-6, 0.004, 0.15, 0.7, 40.0])


def one_sided(u, side):
    return 0.5 * (1 + side * u / np.sqrt(u**2 + V**2)), 0.5 * (1 + side * np.tanh(u / V))


FORMULAS = {
    "viscous": lambda u: u,
    "coulomb": lambda u: np.tanh(u / V),
    "offset": np.ones_like,
    "stribeck": lambda u: np.exp(-((u / W) ** 2)) * np.tanh(u / V),
    "viscous_forward": lambda u: u * one_sided(u, 1)[0],
    "viscous_backward": lambda u: u * one_sided(u, -1)[0],
    "coulomb_forward": lambda u: np.tanh(u / V) * one_sided(u, 1)[1],
    "coulomb_backward": lambda u: np.tanh(u / V) * one_sided(u, -1)[1],
    "sigmoid": lambda u: scipy.special.expit(SLOPE * (u + SHIFT)) - scipy.special.expit(SLOPE * SHIFT),
}


def test_every_coefficient_of_a_law_is_tried():
    assert set(FORMULAS) == set(POTENTIALS) == {*coefficients_of(LAWS)}
    assert shape_of(LAWS) == FrictionShape._fields and coefficients_of(["load"]) == ()


@pytest.mark.parametrize("name", FORMULAS)
def test_the_force_is_the_formula_and_takes_power(name):
    D = joint_dissipation(**{name: np.full(len(RATES), 0.7)}, **SHAPE._asdict())
    force = friction_force(D, jnp.zeros(len(RATES)), jnp.asarray(RATES))
    np.testing.assert_allclose(force, 0.7 * FORMULAS[name](RATES), rtol=1e-12, atol=1e-12)
    if name != "offset":
        assert (np.asarray(force) * RATES >= 0).all() and force[5] == 0
    single = jnp.asarray(RATES, jnp.float32)
    shape = FrictionShape(*(jnp.full(len(RATES), value, jnp.float32) for value in SHAPE))
    assert unit_force(name, single, shape).dtype == POTENTIALS[name](single, shape).dtype == jnp.float32
    np.testing.assert_allclose(unit_force(name, single, shape), FORMULAS[name](RATES), rtol=1e-5, atol=1e-5)


def test_functions_are_the_integrals_of_the_formulas():
    # On the scale of v near rest, where the formulas bend, by Gauss and Legendre's rule between the knots.
    knots = np.concatenate([[0.0], V * 2.0 ** np.arange(-3, 9)])
    nodes, weights = np.polynomial.legendre.leggauss(30)
    middle, half = (knots[1:] + knots[:-1]) / 2, np.diff(knots) / 2
    for name, formula in FORMULAS.items():
        for side in (1, -1):
            integral = side * np.cumsum(half * (formula(side * (middle[:, None] + half[:, None] * nodes)) @ weights))
            values = POTENTIALS[name](jnp.asarray(side * knots), SHAPE)
            np.testing.assert_allclose(values, np.append(0.0, integral), rtol=1e-10, atol=1e-14, err_msg=name)


@pytest.mark.slow
def test_derivatives_by_rate_and_shape_are_differences():
    h = 1e-6

    @jax.jit
    def values(numbers):
        u, shape = jnp.asarray(RATES[1:-1]) + numbers[4], FrictionShape(*numbers[:4])
        return jnp.array([(POTENTIALS[name](u, shape), unit_force(name, u, shape)) for name in FORMULAS])

    numbers = jnp.append(jnp.asarray(SHAPE), 0.0)
    slopes = jax.jit(jax.jacfwd(values))(numbers)
    for place, unit in enumerate(np.eye(5)):
        differences = (values(numbers + h * unit) - values(numbers - h * unit)) / (2 * h)
        np.testing.assert_allclose(slopes[..., place], differences, rtol=1e-5, atol=1e-6)


def test_what_is_not_needed_is_not_there():
    assert joint_dissipation() is None and joint_dissipation(np.zeros(3), 0.0) is None
    assert dynamics(two_link_arm().closed_form).friction([0.1, 0.2], [1.0, 2.0]).tolist() == [0, 0]


def test_what_are_no_laws_and_no_coefficients_is_refused():
    for laws, message in [
        (["viscous", "dahl"], "laws has 'dahl'; expected some of viscous, coulomb, stribeck,"),
        (["viscous", "viscous"], "expected each law once"),
        (["asymmetric", "coulomb"], "asymmetric and coulomb, and no data can tell them apart; leave coulomb out"),
        ([["viscous"]], "expected some of"),
    ]:
        with one_line(message):
            require_laws(laws, "laws")
    for options, message in [
        ({"viscous": -0.1}, "viscous is -0.1; expected finite numbers of at least 0"),
        ({"coulomb": [0.1, np.nan]}, "coulomb is"),
        ({"offset": np.inf}, "offset is inf; expected finite numbers$"),
        ({"coulomb": 0.1, "velocity_scale": 0.0}, "velocity_scale is 0.0; expected a positive number"),
        ({"viscous": 0.1, "stribeck_velocity": [0.1, 0.0]}, r"stribeck_velocity is \[0.1, 0.0\]; expected a positive"),
        ({"viscous": 0.1, "sigmoid_shift": np.nan}, "sigmoid_shift is nan; expected a finite number"),
    ]:
        with one_line(message):
            joint_dissipation(**options)
