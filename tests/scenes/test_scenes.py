"""Scenes against their own kinematics and published constants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.mechanics import lagrangian
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import (
    cart_pole,
    chain,
    double_pendulum,
    flexible_cart_pole,
    joint_angles,
    pendulum,
    two_link_arm,
)


def swing(angle):
    return jnp.stack([jnp.sin(angle), -jnp.cos(angle)])


def rail(x):
    return jnp.stack([x, 0 * x])


CARTESIAN = {
    "pendulum": (pendulum(mass=2.0, length=0.7), lambda q: [0.7 * swing(q[0])], [2.0]),
    "double-pendulum": (
        double_pendulum(masses=(1.5, 0.5), lengths=(0.8, 1.3)),
        lambda q: [0.8 * swing(q[0]), 0.8 * swing(q[0]) + 1.3 * swing(q[1])],
        [1.5, 0.5],
    ),
    "cart-pole": (
        cart_pole(cart_mass=1.2, pole_mass=0.3, length=0.6),
        lambda q: [rail(q[0]), rail(q[0]) + 0.6 * swing(np.pi - q[1])],
        [1.2, 0.3],
    ),
    "flexible-cart-pole": (
        flexible_cart_pole(stiffness=0.0, length=0.6),
        lambda q: [rail(q[0]), rail(q[0] + q[1]), rail(q[0] + q[1]) + 0.6 * swing(np.pi - q[2])],
        [0.57, 0.375, 0.127],
    ),
}
"""Scenes, positions of their masses [2], and masses."""


@pytest.mark.parametrize("name", CARTESIAN)
def test_energies_equal_those_of_the_moving_masses(name):
    scene, positions, masses = CARTESIAN[name]
    d = scene.needs.degrees_of_freedom
    q, qd = jax.random.normal(jax.random.key(0), (2, d))

    def moments(q):
        return np.array(masses) @ jnp.stack(positions(q))

    @jax.jit
    def energies(q, qd):
        velocity = jax.jvp(lambda q: jnp.stack(positions(q)), (q,), (qd,))[1]
        kinetic = 0.5 * jnp.sum(np.array(masses) @ velocity**2)
        height = moments(q)[1] - moments(jnp.zeros(d))[1]
        V = scene.potential(q)
        return kinetic, 9.81 * height, lagrangian.energy(scene.lagrangian, q, qd) - V, V - scene.potential(jnp.zeros(d))

    kinetic, potential, *ours = map(float, energies(q, qd))
    assert ours == [pytest.approx(kinetic, rel=1e-12), pytest.approx(potential, rel=1e-11)]


def test_the_arm_has_the_published_constants_from_either_zero():
    """Protocols of Lutter et al., in the form M(q2), c(q, qd), g(q)."""
    q, qd, qdd = jnp.array([[0.3, -1.1], [0.7, 1.9], [-2.0, 0.4]])
    c, s = np.cos(-1.1), np.sin(-1.1)
    first = (1.3727291666666667 + c) * -2.0 + (0.5176145833333333 + 0.5 * c) * 0.4
    first += -0.5 * s * (2 * 0.7 * 1.9 + 1.9**2) + 2.625 * np.cos(0.3) + 1.5 * np.cos(0.3 - 1.1)
    second = (0.5176145833333333 + 0.5 * c) * -2.0 + 0.5176145833333333 * 0.4
    second += 0.5 * s * 0.7**2 + 1.5 * np.cos(0.3 - 1.1)
    for arm, zero in ((two_link_arm(), 0.0), (two_link_arm(zero="hanging"), jnp.pi / 2)):
        shifted = q + jnp.array([zero, 0.0])
        got = dynamics(arm.closed_form).inverse_dynamics(shifted, qd, qdd)
        np.testing.assert_allclose(got, [first, second], rtol=1e-13)
        np.testing.assert_allclose(arm.tip(shifted), two_link_arm().tip(q), rtol=1e-12)


def test_inverse_kinematics_reaches_the_tip():
    tips = jax.random.uniform(jax.random.key(2), (100, 2), minval=0.2, maxval=1.3)
    angles = jax.vmap(joint_angles)(tips)
    np.testing.assert_allclose(jax.vmap(two_link_arm().tip)(angles), tips, rtol=1e-12)
    assert (angles[:, 1] > 0).all()
    assert jnp.isnan(joint_angles(jnp.array([3.0, 0.0]))).all()


def test_needs_name_motors_and_a_chain_has_links():
    assert cart_pole().needs.actuation == ((1.0,), (0.0,))
    with one_line("at least 1"):
        chain(0)
