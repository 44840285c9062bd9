"""The flexible cart-pole: forces by hand against its energies, and its linear equations by hand."""

import jax
import numpy as np
from numpy.testing import assert_allclose

from dln_jax.control.state_space import field_of, linearise
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import flexible_cart_pole

SCENE = flexible_cart_pole()
B = np.asarray(SCENE.needs.actuation)
FIELD = jax.jit(field_of(dynamics(SCENE.energies), B))


def test_forces_by_hand_are_those_of_the_energies():
    q, qd, qdd = jax.random.normal(jax.random.key(0), (3, 3))
    by_hand = dynamics(SCENE.closed_form).inverse_dynamics(q, qd, qdd)
    inverse = jax.jit(dynamics(SCENE.energies).inverse_dynamics)
    assert_allclose(inverse(q, qd, qdd), by_hand, rtol=1e-11)


def test_the_linearisation_is_that_of_the_paper():
    # Section 2 of the paper, the pole's angle turned round and its misprinted hinge corrected.
    m, carried, pole, k, l, b1, b2, b3, g = 0.57, 0.375, 0.127, 200.0, 0.1778, 0.5, 0.5, 0.0024, 9.81
    second = [0, -k / m - k / carried, -pole * g / carried, b1 / m - b2 / carried, -b2 / carried, b3 / (carried * l)]
    hinge = b3 * (carried + pole) / (carried * pole * l**2)
    third = [0, k / (carried * l), g * (carried + pole) / (carried * l), *(2 * [b2 / (carried * l)]), -hinge]
    expected = [[0, k / m, 0, -b1 / m, 0, 0], second, third]
    found = linearise(FIELD, np.zeros(6), np.zeros(1))
    assert_allclose(found.A, np.vstack([np.eye(3, 6, 3), expected]), rtol=1e-10, atol=1e-10)
    assert_allclose(found.B[:, 0], [0, 0, 0, 1 / m, -1 / m, 0], rtol=1e-10, atol=1e-12)
