"""Each law of friction by its formula, its integral and its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from dln_jax.mechanics.dynamics import friction_force
from dln_jax.mechanics.friction import (
    LAWS,
    FrictionShape,
    coefficients_of,
    joint_dissipation,
    require_laws,
    shape_of,
    unit_force,
)
from dln_jax.mechanics.friction.curves import POTENTIALS
from dln_jax.types import InputError

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
    shape = SHAPE._asdict()
    D = joint_dissipation(**{name: np.full(len(RATES), 0.7)}, **shape)
    force = friction_force(D, jnp.zeros(len(RATES)), jnp.asarray(RATES))
    np.testing.assert_allclose(force, 0.7 * FORMULAS[name](RATES), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(unit_force(name, jnp.asarray(RATES), SHAPE), force / 0.7, rtol=1e-14)
    if name != "offset":
        assert (np.asarray(force) * RATES >= 0).all() and force[5] == 0
        assert D(jnp.zeros(len(RATES)), jnp.asarray(RATES)) > 0


@pytest.mark.parametrize("name", FORMULAS)
def test_the_function_is_the_integral_of_the_formula(name):
    # On the scale of v near rest, where the formulas bend, by Gauss and Legendre's rule between the knots.
    knots = np.concatenate([[0.0], V * 2.0 ** np.arange(-3, 9)])
    nodes, weights = np.polynomial.legendre.leggauss(30)
    for side in (1, -1):
        middle, half = (knots[1:] + knots[:-1]) / 2, np.diff(knots) / 2
        values = FORMULAS[name](side * (middle[:, None] + half[:, None] * nodes))
        integral = side * np.cumsum(half * (values @ weights))
        values = POTENTIALS[name](jnp.asarray(side * knots), SHAPE)
        np.testing.assert_allclose(values, np.concatenate([[0.0], integral]), rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("function", [unit_force, lambda name, u, shape: POTENTIALS[name](u, shape)])
@pytest.mark.parametrize("name", FORMULAS)
def test_derivatives_by_rate_and_shape_are_differences(name, function):
    h = 1e-6

    @jax.jit
    def values(numbers):
        return function(name, jnp.asarray(RATES[1:-1]) + numbers[4], FrictionShape(*numbers[:4]))

    numbers = jnp.append(jnp.asarray(SHAPE), 0.0)
    for unit, slope in zip(np.eye(5), jax.jit(jax.jacfwd(values))(numbers).T, strict=True):
        differences = (values(numbers + h * unit) - values(numbers - h * unit)) / (2 * h)
        np.testing.assert_allclose(slope, differences, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", FORMULAS)
def test_single_precision_stays_single(name):
    u = jnp.asarray(RATES, jnp.float32)
    shape = FrictionShape(*(jnp.full(len(RATES), value, jnp.float32) for value in SHAPE))
    assert unit_force(name, u, shape).dtype == POTENTIALS[name](u, shape).dtype == jnp.float32
    np.testing.assert_allclose(unit_force(name, u, shape), FORMULAS[name](RATES), rtol=1e-5, atol=1e-5)


def test_what_is_not_asked_for_is_not_computed():
    """Stribeck's integral takes an error function and 40 nodes, its force neither."""
    D = joint_dissipation(stribeck=0.2)
    programs = [
        jax.jit(function).lower(jnp.zeros(2), jnp.zeros(2)).as_text() for function in (D, jax.grad(D, argnums=1))
    ]
    assert ["chlo.erf" in text or "2x40xf64" in text for text in programs] == [True, False]


def test_equal_in_both_directions_is_viscous_and_coulomb():
    u = jnp.linspace(-1, 1, 11)
    parts = {name: unit_force(name, u, SHAPE) for name in FORMULAS}
    np.testing.assert_allclose(parts["viscous_forward"] + parts["viscous_backward"], u, atol=1e-15)
    np.testing.assert_allclose(parts["coulomb_forward"] + parts["coulomb_backward"], parts["coulomb"], atol=1e-15)


def test_rates_of_joints_are_those_of_a_map():
    J = np.array([[1.0, 0.0], [-1.0, 1.0]])
    D, mapped = (joint_dissipation([0.2, 0.1], [0.5, 0.3], joint_map=map_) for map_ in (None, J))
    qd = jnp.array([0.7, -0.4])
    np.testing.assert_allclose(mapped(qd, qd), D(qd, J @ qd))
    np.testing.assert_allclose(friction_force(mapped, qd, qd), J.T @ friction_force(D, qd, J @ qd))


@pytest.mark.parametrize(
    "laws, message",
    [
        (["viscous", "dahl"], "laws has 'dahl'; expected some of viscous, coulomb, stribeck,"),
        (["viscous", "viscous"], "expected each law once"),
        (["asymmetric", "coulomb"], "asymmetric and coulomb, which no data can tell apart; leave one out"),
        ([["viscous"]], "expected some of"),
    ],
)
def test_what_are_no_laws_is_refused(laws, message):
    with pytest.raises(InputError, match=message) as caught:
        require_laws(laws, "laws")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"stribeck_velocity": [0.1, 0.0]}, r"stribeck_velocity is \[0.1, 0.0\]; expected a positive number"),
        ({"sigmoid_slope": np.inf}, "sigmoid_slope is inf"),
        ({"sigmoid_shift": np.nan}, "sigmoid_shift is nan; expected a finite number"),
    ],
)
def test_what_is_no_shape_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        joint_dissipation(0.1, **options)
