"""Compensated friction does no work at rest, and is friction's own away from it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.control.tracking import friction_compensation, without_friction
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import FrictionCoefficients
from dln_jax.scenes.pendulums import cart_pole
from dln_jax.scenes.scene import with_friction

NOMINAL = cart_pole(cart_mass=0.57, pole_mass=0.127, length=0.16825)
FRICTION_LAW = FrictionCoefficients(viscous=(0.1, 1e-3), coulomb=(0.3, 5e-4), stribeck=(0.1, 2e-4))
PLANT = dynamics(with_friction(NOMINAL, FRICTION_LAW).closed_form)
FRICTION = jax.jit(PLANT.friction)


def test_it_does_no_work_at_rest_and_is_friction_s_share_away_from_it():
    forces = jax.jit(friction_compensation(PLANT, [0], smoothing=0.05, gain=0.9))
    q = jnp.array([0.1, 2.0])
    assert float(jnp.abs(forces(q, jnp.array([0.0, 3.0]))[0])) < 1e-15
    for rate in (-2.0, 2.0):
        qd = jnp.array([rate, 3.0])
        assert forces(q, qd)[0] == pytest.approx(0.9 * float(FRICTION(q, qd)[0]), rel=1e-3)
    # Never more than what friction takes, so that no joint is driven by it.
    rates = np.linspace(-0.3, 0.3, 61)
    given = np.array([forces(q, jnp.array([rate, 0.0]))[0] for rate in rates])
    taken = np.array([FRICTION(q, jnp.array([rate, 0.0]))[0] for rate in rates])
    assert (given * rates <= taken * rates + 1e-12).all()


def test_what_is_left_without_friction_is_the_frictionless_plant():
    bare = dynamics(NOMINAL.closed_form)
    state = jnp.array([0.1, 2.0]), jnp.array([0.4, -3.0]), jnp.array([0.5, 0.2])
    left = without_friction(PLANT)
    np.testing.assert_allclose(jax.jit(left.inverse_dynamics)(*state), bare.inverse_dynamics(*state), rtol=1e-10)
    np.testing.assert_allclose(jax.jit(left.forward_dynamics)(*state), bare.forward_dynamics(*state), rtol=1e-10)


def test_settings_out_of_range_are_refused():
    for settings, message in (({"smoothing": 0.0}, "smoothing is 0"), ({"smoothing": 0.1, "gain": 1.2}, "gain is 1.2")):
        with one_line(message):
            friction_compensation(PLANT, [0], **settings)
