"""A swing-up takes any model that it can use, and says in one line why it cannot use another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax.control.closed_loop import outcomes
from dln_jax.control.desktop_plants import desktop_plant, law_of, model_of_plant, nominal_model, try_starts
from dln_jax.control.estimate.kalman import mechanical
from dln_jax.control.plants.estimators import by_filter
from dln_jax.control.swing_up import nearest_equilibrium, swing_up
from dln_jax.mechanics.dynamics import InverseForward
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.lagrangian import LagrangianSystem

PLANT = desktop_plant("rotary-pendulum")
NOMINAL = nominal_model(PLANT)


def with_potential(extra):
    """The nominal model with another energy added."""
    L = PLANT.nominal(**PLANT.sizes).lagrangian
    return dynamics(LagrangianSystem(lambda q, qd: L(q, qd) - extra(q)))


def test_dry_friction_holds_no_pole_down():
    model = model_of_plant(PLANT)
    settings = {"starts": 8, "seed": 5, "seconds": 3.0}
    tried = try_starts(PLANT, model, **settings)
    assert tried.outcomes.share == 1
    # A filter that knows the plant's own noise holds it with less torque.
    noise = {"band": [2.5e-4, 1e-5], "encoder_step": PLANT.hardware.encoder_step}
    process = mechanical(model, PLANT.scene.needs.actuation, rate=PLANT.rate, **noise)
    filtering = try_starts(PLANT, model, **settings, estimator=by_filter(PLANT.layout, process, delay=1))
    assert filtering.outcomes.share == 1 and np.median(filtering.effort) < 0.3 * np.median(tried.effort)
    # Exactly at rest, where the energy law asks for nothing.
    law = jax.jit(law_of(PLANT, NOMINAL).law)
    assert jnp.abs(law(jnp.array([0.0, np.pi, 0.0, 0.0]))[0]) == pytest.approx(PLANT.numbers.kick)
    for place in range(4):
        assert np.isnan(law(jnp.array([0.1, 3.0, 0.2, 0.3]).at[place].set(jnp.nan))).all()


def test_the_model_s_own_equilibrium_is_found():
    tilted = with_potential(lambda q: 1e-3 * q[1])
    weight = PLANT.sizes["pole_mass"] * 9.81 * PLANT.sizes["pole_length"] / 2
    home = nearest_equilibrium(tilted, np.zeros(2), (1,))
    assert_allclose(home, [0.0, np.arcsin(1e-3 / weight)], atol=1e-10)


def test_models_that_cannot_be_used_are_refused():
    indefinite = LagrangianSystem(lambda q, qd: 0.5 * qd[0] ** 2 - 0.5 * qd[1] ** 2)
    postures = np.stack([np.zeros(9), np.linspace(-np.pi, np.pi, 9)], axis=1)
    limits = {"lower": PLANT.hardware.lower, "upper": PLANT.hardware.upper}
    needs = PLANT.scene.needs
    for model, message in (
        (InverseForward(*NOMINAL[:2]), "has no energy"),
        (dynamics(indefinite), "not positive definite"),
        (with_potential(lambda q: 0.1 * q[1]), "no equilibrium near the goal"),
        (with_potential(lambda q: 0.2 * q[0]), "do not hold the goal"),  # the motor is too weak
    ):
        with one_line(message):
            swing_up(model, needs.actuation, needs.joints, np.zeros(2), PLANT.numbers, postures=postures, **limits)


def test_runs_that_are_not_finite_are_failures_and_counted():
    angle = np.array([[3.1, 0.2, 0.05, 0.05], [3.1, 0.05, np.nan, np.nan], [0.0, 0.0, 0.0, 0.0], [3.1, 0.0, 0.0, 0.3]])
    found = outcomes(angle, rate=10.0)
    assert_allclose(found.seconds, [0.2, np.inf, 0.0, np.inf])
    assert_array_equal(found.failed, [False, True, False, False])
    assert found.share == 0.5 and found.worst == 0.2
    assert outcomes(angle + 2 * np.pi, rate=10.0).share == 0.5
