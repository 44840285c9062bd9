"""A tree of learned frames is a model like any other, and what it calls gauges has no effect on torques."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import moved
from dln_jax.models.serial_tree import make_serial_tree, rotation, rotation_vector
from dln_jax.types import InputError, Needs

KINDS = ("revolute", "prismatic", "revolute")
NEEDS = Needs(joints=KINDS, friction=True)


@jax.jit
def torque(parameters):
    q, qd, qdd = map(jnp.asarray, np.random.default_rng(2).normal(size=(3, 3)))
    return dynamics(make_serial_tree(NEEDS).energies(parameters)).inverse_dynamics(q, qd, qdd)


@pytest.mark.parametrize("link", range(3))
@pytest.mark.parametrize("slide", [False, True])
def test_a_links_frame_may_turn_about_and_slide_along_its_axis(link, slide):
    model = make_serial_tree(NEEDS)
    parameters = model.init(jax.random.key(1))
    turn, shift = (np.eye(3), np.array([0, 0, 0.3])) if slide else (rotation(jnp.array([0, 0, 0.7])), np.zeros(3))
    rotations, positions = np.array(jax.vmap(rotation)(parameters.turns)), np.array(parameters.positions)
    inertias = np.array(parameters.inertias)
    # The new frame in the old one is (turn, shift); body and next frame are seen from it.
    positions[link] += rotations[link] @ shift
    rotations[link] = rotations[link] @ turn
    back = np.array(turn).T
    inertias[link] = moved(inertias[link], back, -back @ shift)
    if link + 1 < 3:
        rotations[link + 1] = back @ rotations[link + 1]
        positions[link + 1] = back @ (positions[link + 1] - shift)
    turns = np.array([rotation_vector(each) for each in rotations])
    changed = {"turns": turns, "positions": positions, "inertias": inertias}
    other = parameters._replace(**{name: jnp.asarray(each) for name, each in changed.items()})
    np.testing.assert_allclose(torque(other), torque(parameters), atol=1e-11)


def test_rotation_vectors_and_matrices_are_inverse():
    for angle in [0.0, 1e-9, 1e-3, 2.0, 3.0, np.pi]:
        for axis in np.random.default_rng(3).normal(size=(20, 3)):
            matrix = np.asarray(rotation(jnp.asarray(angle * axis / np.linalg.norm(axis))))
            np.testing.assert_allclose(rotation(jnp.asarray(rotation_vector(matrix))), matrix, atol=1e-12)


def test_rotations_are_differentiable_at_zero():
    slope = jax.jacfwd(rotation)(jnp.zeros(3))
    np.testing.assert_allclose(slope[2, 1], [1, 0, 0], atol=1e-15)
    assert np.isfinite(slope).all()


def test_what_cannot_be_is_refused():
    for keywords, word in [({"parents": (0, 1, 2)}, "parents"), ({"velocity_scale": 0.0}, "velocity_scale")]:
        with pytest.raises(InputError, match=word):
            make_serial_tree(NEEDS, **keywords)
        with pytest.raises(InputError, match="actuation"):
            make_serial_tree(NEEDS._replace(actuation=((1.0,), (0.0,), (0.0,))))
