"""The scan over links gives the forces of the recursions, for chains and trees, turning and sliding joints."""

import jax
import numpy as np
import pytest

from dln_jax.mechanics.trees.description import make_tree
from dln_jax.mechanics.trees.recursions import newton_euler, scanned_forces, scanned_regressor

KINDS = ("revolute", "prismatic", "revolute")


@pytest.mark.parametrize("parents", [(-1, 0, 1), (-1, 0, 0)])
def test_forces_are_those_of_the_recursions(parents):
    random = np.random.default_rng(0)
    rotations, _ = np.linalg.qr(random.normal(size=(3, 3, 3)))
    rotations *= np.sign(np.linalg.det(rotations))[:, None, None]
    positions, inertias, gravity = random.normal(size=(3, 3)), random.normal(size=(3, 10)), random.normal(size=3)
    tree = make_tree(parents, KINDS, rotations, positions, np.tile([0, 0, 1], (3, 1)), inertias, gravity=gravity)
    states = random.normal(size=(3, 5, 3))
    expected = jax.jit(jax.vmap(lambda *state: newton_euler(tree, *state)))(*states)
    forces = jax.jit(jax.vmap(lambda *state: scanned_forces(tree, *state)))(*states)
    np.testing.assert_allclose(forces, expected, atol=1e-11)
    Phi = jax.jit(jax.vmap(lambda *state: scanned_regressor(tree, *state)))(*states)
    np.testing.assert_allclose(np.einsum("njip,ip->nj", Phi, inertias), expected, atol=1e-11)
