"""Moves between valleys do what they say, and the mirror image of an arm takes the same torques."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.learning.kinematics.frames import (
    KinematicPrior,
    mirror_image,
    random_frames,
    rough_frames,
    turn_round,
)
from dln_jax.mechanics.trees.description import make_tree
from dln_jax.mechanics.trees.frames import world_frames
from dln_jax.mechanics.trees.inertia import parts
from dln_jax.mechanics.trees.recursions import newton_euler

PARENTS = (-1, 0, 1, 0)
KINDS = ("revolute", "prismatic", "revolute", "revolute")


def tree(frames, inertias):
    return make_tree(PARENTS, KINDS, *frames, np.tile([0, 0, 1], (4, 1)), inertias)


@pytest.fixture
def frames():
    return random_frames(4, np.random.default_rng(0))


def test_a_joint_turned_round_moves_all_behind_it_the_other_way(frames):
    links = np.ones((4, 10))
    for joint, q in enumerate(0.8 * np.eye(4)):
        one, other = tree(frames, links), tree(turn_round(frames, PARENTS, joint), links)
        found, expected = (world_frames(each, jnp.asarray(sign * q))[1] for each, sign in ((one, 1), (other, -1)))
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_the_mirror_image_takes_the_same_torques(frames):
    inertias = np.random.default_rng(1).normal(size=(4, 10))
    flipped = []
    for theta, kind in zip(inertias, KINDS, strict=True):
        # Links that turn are seen from frames with y and z reversed.
        mirror = np.diag([-1.0, -1.0, -1.0]) if kind == "revolute" else np.diag([-1.0, 1.0, 1.0])
        m, h, moments = parts(theta)
        moments = mirror @ moments @ mirror
        flipped.append([m, *(mirror @ h), *moments[np.triu_indices(3)]])
    image = tree(mirror_image(frames, PARENTS, KINDS), np.array(flipped))
    states = np.random.default_rng(2).normal(size=(3, 2, 4))
    original = tree(frames, inertias)
    found, expected = (jax.jit(jax.vmap(functools.partial(newton_euler, each)))(*states) for each in (image, original))
    np.testing.assert_allclose(found, expected, atol=1e-11)


def test_rough_frames_are_as_far_off_as_is_said(frames):
    found = rough_frames(KinematicPrior(frames, 0.3, 0.1), np.random.default_rng(3))
    np.testing.assert_allclose(np.linalg.norm(found.positions - frames.positions, axis=1), 0.1, atol=1e-12)
    between = np.swapaxes(frames.rotations, 1, 2) @ found.rotations
    np.testing.assert_allclose(np.trace(between, axis1=1, axis2=2), 1 + 2 * np.cos(0.3), atol=1e-12)
