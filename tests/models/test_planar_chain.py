"""Planar chains against the textbook double pendulum and cart-pole, in both coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
from calls import one_line

from dln_jax.mechanics.equations import dynamics
from dln_jax.models.trigonometric import make_planar_chain
from dln_jax.scenes.pendulums import cart_pole, double_pendulum
from dln_jax.types import Needs
from tests.models.random_parameters import drawn

NEEDS = Needs(joints=("revolute", "revolute"), friction=True)
TO_RELATIVE = np.array([[1.0, 0.0], [-1.0, 1.0]])
STATE = tuple(map(np.array, ([0.4, -1.3], [1.1, 2.0], [0.3, -0.7])))


def torque(system, state=STATE):
    return jax.jit(dynamics(system).inverse_dynamics)(*state)


def test_textbook_double_pendulum():
    model = make_planar_chain(NEEDS._replace(friction=False), coordinates="absolute")
    masses, lengths, g = (1.3, 0.7), (0.9, 1.2), 9.81
    inner, outer = lengths
    parameters = model.init(jax.random.key(0))._replace(
        moments=jnp.array([sum(masses) * inner**2, masses[1] * inner * outer, masses[1] * outer**2]),
        weight=jnp.array([sum(masses) * g * inner, masses[1] * g * outer]),
    )
    book = double_pendulum(masses=masses, lengths=lengths).energies
    np.testing.assert_allclose(torque(model.energies(parameters)), torque(book), rtol=1e-13)


def test_textbook_cart_pole():
    book = cart_pole().closed_form
    model = make_planar_chain(Needs(joints=("prismatic", "revolute"), friction=False))
    M = book.mass_matrix(jnp.zeros(2))
    below, above = (book.potential(jnp.array([0.0, angle])) for angle in (0.0, np.pi))
    parameters = model.init(jax.random.key(0))._replace(
        moments=jnp.array([M[0, 0], M[1, 0], M[1, 1]]), weight=jnp.array([0.0, (above - below) / 2])
    )
    np.testing.assert_allclose(torque(model.energies(parameters)), torque(book), rtol=1e-13)


def test_coordinates_do_not_matter():
    """Forces of angles from the vertical are those of joints, turned by the transpose of the map between rates."""
    for symmetric in (True, False):
        absolute, relative = (
            make_planar_chain(NEEDS, coordinates=each, symmetric=symmetric, armature=True)
            for each in ("absolute", "relative")
        )
        parameters = drawn(absolute)
        M = absolute.energies(parameters).mass_matrix(STATE[0])
        np.testing.assert_allclose(M, M.T, rtol=1e-14)
        turned = torque(relative.energies(parameters), [TO_RELATIVE @ each for each in STATE])
        np.testing.assert_allclose(torque(absolute.energies(parameters)), TO_RELATIVE.T @ turned, rtol=1e-12)


def test_friction_acts_in_the_joints():
    """Links that turn alike do not rub at the second joint."""
    model = make_planar_chain(NEEDS, coordinates="absolute")
    parameters = drawn(model)
    friction = dynamics(model.energies(parameters)).friction
    alike = np.asarray(friction(np.zeros(2), np.ones(2)))
    assert alike[1] == 0 != alike[0]


def test_mistakes_are_named():
    for needs, options, message in [
        (Needs(joints=("revolute", "prismatic")), {}, "slides before hinges"),
        (NEEDS, {"directions": (1, 2)}, r"directions are \(1, 2\)"),
        (NEEDS, {"coordinates": "polar"}, "coordinates are 'polar'"),
    ]:
        with one_line(message):
            make_planar_chain(needs, **options)
