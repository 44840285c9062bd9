"""Friction joins any scene as the formulas say."""

import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import FrictionCoefficients, FrictionShape
from dln_jax.scenes.pendulums import cart_pole, two_link_pendulum
from dln_jax.scenes.scene import with_friction


def test_forces_are_those_of_the_formulas():
    scene = two_link_pendulum("elbow")
    coefficients = FrictionCoefficients(viscous=(0.1, 0.2), coulomb=0.3, stribeck=(0.05, 0.0))
    rubbing = with_friction(scene, coefficients, FrictionShape(0.02, 0.1))
    q, qd = jnp.array([0.3, 0.7]), jnp.array([0.08, -1.5])
    before, after = dynamics(scene.energies), dynamics(rubbing.energies)
    stribeck = np.array([0.05, 0.0]) * np.exp(-((qd / 0.1) ** 2))
    wanted = np.array([0.1, 0.2]) * qd + (0.3 + stribeck) * np.tanh(qd / 0.02)
    np.testing.assert_allclose(after.friction(q, qd) - before.friction(q, qd), wanted, rtol=1e-10)
    assert rubbing.needs.joint_friction == ("viscous", "coulomb", "stribeck")
    assert float(after.energy(q, qd)) == pytest.approx(float(before.energy(q, qd)), rel=1e-12)


def test_mistakes_are_one_line():
    for coefficients, message in [
        (FrictionCoefficients(), "all friction coefficients are zero"),
        (FrictionCoefficients(sigmoid=1.0), "no sigmoid friction"),
        (FrictionCoefficients(coulomb=-1.0), "coulomb is -1"),
    ]:
        with one_line(message):
            with_friction(cart_pole(), coefficients)
