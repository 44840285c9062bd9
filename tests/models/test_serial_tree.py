"""Rotation vectors of a tree of learned frames, and what such a tree cannot have."""

import jax
import jax.numpy as jnp
import numpy as np
from calls import one_line
from scipy.spatial.transform import Rotation

from dln_jax.models.trees import make_serial_tree, rotation
from dln_jax.types import Needs

NEEDS = Needs(joints=("revolute", "prismatic", "revolute"), friction=True)


def test_rotation_vectors_and_matrices_are_inverse():
    for angle in [0.0, 1e-9, 1e-3, 2.0, 3.0, np.pi]:
        for axis in np.random.default_rng(3).normal(size=(20, 3)):
            matrix = np.asarray(rotation(jnp.asarray(angle * axis / np.linalg.norm(axis))))
            np.testing.assert_allclose(
                rotation(jnp.asarray(Rotation.from_matrix(matrix).as_rotvec())), matrix, atol=1e-12
            )


def test_rotations_are_differentiable_at_zero():
    slope = jax.jacfwd(rotation)(jnp.zeros(3))
    np.testing.assert_allclose(slope[2, 1], [1, 0, 0], atol=1e-15)
    assert np.isfinite(slope).all()


def test_what_cannot_be_is_refused():
    for needs, keywords, word in [
        (NEEDS, {"parents": (0, 1, 2)}, "parents"),
        (NEEDS, {"velocity_scale": 0.0}, "velocity_scale"),
        (NEEDS._replace(actuation=((1.0,), (0.0,), (0.0,))), {}, "actuation"),
    ]:
        with one_line(word):
            make_serial_tree(needs, **keywords)
