"""Two trees are the same arm if one can be moved, mirror_image and turned about its axes to become the other."""

import numpy as np
from scipy.spatial.transform import Rotation

from dln_jax.learning.kinematics.frames import Frames, mirror_image, random_frames, turn_round
from dln_jax.learning.kinematics.projection import Structure
from dln_jax.learning.kinematics.search import difference

D = 4
CHAIN = Structure((-1, 0, 1, 2), ("revolute",) * D, 9.81, True, 0.01)


def regauged(frames, random):
    """The same arm with other frames: the base elsewhere, turned about the vertical; frames turned about, and moved
    along, their axes."""

    def turn():
        return Rotation.from_rotvec([0, 0, random.normal()]).as_matrix()

    rotations, positions = np.array(frames.rotations), random.normal(size=(D, 3))
    positions[1:], rotations[0] = frames.positions[1:], turn() @ rotations[0]
    for link in range(D):
        own, along = turn(), np.array([0, 0, random.normal()])
        positions[link] += rotations[link] @ along
        rotations[link] = rotations[link] @ own
        if link + 1 < D:
            rotations[link + 1] = own.T @ rotations[link + 1]
            positions[link + 1] = own.T @ (positions[link + 1] - along)
    return Frames(rotations, positions)


def test_gauges_make_no_difference():
    for parallel in (False, True):
        random = np.random.default_rng(0)
        frames = random_frames(D, random)
        if parallel:
            level = Rotation.from_rotvec([np.pi / 2, 0, 0]).as_matrix()
            frames = frames._replace(rotations=np.stack([level, *[np.eye(3)] * (D - 1)]))
        off = difference(frames, mirror_image(regauged(frames, random), CHAIN.parents, CHAIN.joints), CHAIN)
        assert off.angle < 1e-5 and off.length < 1e-5 and off.same


def test_other_arms_differ_by_what_they_were_moved():
    frames = random_frames(D, np.random.default_rng(1))
    positions = np.array(frames.positions)
    positions[2] += 0.1 * np.asarray(frames.rotations[2])[:, 0]
    moved = difference(frames, frames._replace(positions=positions), CHAIN)
    assert 0.02 < moved.length <= 0.1 and not moved.same
    reversed_joint = difference(frames, turn_round(frames, CHAIN.parents, 1), CHAIN)
    assert reversed_joint.angle > 0.5 and not reversed_joint.same
