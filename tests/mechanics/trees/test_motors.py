"""Motors that turn with several joints: their energy, forces and mass matrix agree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees.description import dh_frames, serial
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.mechanics.trees.motors import armature_matrix, motor_regressor, motors_of, require_motors, single_motors
from dln_jax.mechanics.trees.recursions import composite_bodies, kinetic_energy, newton_euler
from dln_jax.models.trees import make_rigid_tree

FRAMES = dh_frames([[0, 0, 0.3, 0], [-np.pi / 2, 0, 0, 0], [0, 0.4, 0, 0.2]])
LINKS = [inertial_parameters(m, [0.05, -0.02, 0.1], np.diag([0.02, 0.03, 0.01])) for m in (3.0, 2.0, 1.0)]
S = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 1.0, 1.0))
INERTIAS, PAIRS = np.array([0.1, 0.2, 0.3]), ((0, 1),)
A = np.asarray(armature_matrix(INERTIAS, S, {(0, 1): 0.05}))
STATE = np.random.default_rng(0).normal(size=(3, 3))


def test_the_armature_is_that_of_the_motors_kinetic_energy():
    u = np.array(S) @ STATE[1]
    energy = 0.5 * np.sum(INERTIAS * u**2) + 0.05 * u[0] * u[1]
    assert 0.5 * STATE[1] @ A @ STATE[1] == pytest.approx(energy)
    arm = serial(*FRAMES, LINKS, armature=A)
    bare = serial(*FRAMES, LINKS)
    q, qd, qdd = map(jnp.asarray, STATE)
    np.testing.assert_allclose(composite_bodies(arm, q) - composite_bodies(bare, q), A, atol=1e-14)
    assert kinetic_energy(arm, q, qd) - kinetic_energy(bare, q, qd) == pytest.approx(energy)
    difference = newton_euler(arm, q, qd, qdd) - newton_euler(bare, q, qd, qdd)
    np.testing.assert_allclose(difference, A @ STATE[2], atol=1e-13)
    columns = motor_regressor(S, PAIRS, qdd)
    np.testing.assert_allclose(columns @ np.append(INERTIAS, 0.05), difference, atol=1e-13)


def test_friction_of_coupled_motors_acts_at_their_rates():
    """Its power is that lost in the motors, sum of b u² + c |u|."""
    model = make_rigid_tree(serial(*FRAMES, LINKS), friction=("viscous", "coulomb"), velocity_scale=1e-4, motors=S)
    parameters = model.init(jax.random.key(0))._replace(viscous=np.array([0.1, 0.2, 0.3]), coulomb=np.full(3, 0.4))
    force = dynamics(model.energies(parameters)).friction(*STATE[:2])
    u = np.array(S) @ STATE[1]
    assert force @ STATE[1] == pytest.approx(np.sum([0.1, 0.2, 0.3] * u**2 + 0.4 * abs(u)))


def test_motors_and_armature_are_converted_back_and_forth():
    inertias, entries = motors_of(A, S, PAIRS)
    np.testing.assert_allclose(inertias, INERTIAS)
    np.testing.assert_allclose(entries, [0.05])
    own, motors = single_motors(A)
    rebuilt = np.diag(own) + sum(inertia * np.outer(c, c) for inertia, c in motors)
    np.testing.assert_allclose(rebuilt, A, atol=1e-15)
    own, ((inertia, c),) = single_motors(armature_matrix(INERTIAS, S))
    assert inertia == pytest.approx(0.3) and own.tolist() == pytest.approx([0.1, 0.2, 0.0])
    np.testing.assert_allclose(c, S[2])


def test_invalid_motors_are_refused():
    arm = serial(*FRAMES, LINKS, armature=A)
    for make, message in (
        (lambda: require_motors(np.ones((3, 3)), (), 3), "motors is .* expected an invertible matrix"),
        (lambda: require_motors(None, ((1, 1),), 3), "coupled is 2:2; expected distinct pairs i:j of joints"),
        (lambda: make_rigid_tree(arm), "armature couples joints 2 and 3, .* or couple them .--coupled 2:3"),
        (lambda: make_rigid_tree(arm, cooling=0.1), "cooling is 0.1, but friction has no law; add 'viscous'"),
        (lambda: serial(*FRAMES, LINKS, armature=A - np.eye(3)), "armature is not symmetric positive semidefinite"),
    ):
        with one_line(message):
            make()
