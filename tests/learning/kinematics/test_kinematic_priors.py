"""A kinematic prior in space gives the frames of the arm that it describes, up to what torques do not show."""

import numpy as np
import pytest
from calls import one_line

from dln_jax.learning.kinematics.frames import frames_of_axes, kinematic_prior_from_json
from scripts.reports.robots.simulated_arms import panda

TREE = panda(3).tree
BRANCHED = (-1, 0, 0)


def in_space(frames, parents):
    """Axes and origins of links whose frames are in those of others."""
    rotations, positions = [], []
    for R, p, parent in zip(*frames, parents, strict=True):
        before, at = (np.eye(3), np.zeros(3)) if parent < 0 else (rotations[parent], positions[parent])
        rotations.append(before @ R)
        positions.append(at + before @ p)
    return np.array(rotations)[:, :, 2], np.array(positions)


@pytest.mark.parametrize("parents", [TREE.parents, BRANCHED])
def test_axes_and_points_in_space_are_those_of_the_frames(parents):
    axes, points = in_space((TREE.rotations, TREE.positions), parents)
    found = in_space(frames_of_axes(2 * axes, points, parents), parents)
    np.testing.assert_allclose(found, (axes, points), atol=1e-12)


def test_json_has_axes_or_denavit_hartenberg_rows():
    axes, points = in_space((TREE.rotations, TREE.positions), TREE.parents)
    right = np.pi / 2
    rows = [[0, 0, 0.333, 0], [-right, 0, 0, 0], [right, 0, 0.316, 0]]
    one = kinematic_prior_from_json(
        {"axes": axes.tolist(), "points": points.tolist(), "angle_degrees": 10, "length": 0.1}, 3
    )
    other = kinematic_prior_from_json({"dh_rows": rows}, 3)
    assert (one.angle, one.length) == (pytest.approx(np.radians(10)), 0.1)
    assert (other.angle, other.length) == (pytest.approx(np.radians(30)), 0.05)
    np.testing.assert_allclose(in_space(other.frames, TREE.parents), in_space(one.frames, TREE.parents), atol=1e-12)


def test_what_is_no_kinematic_prior_is_refused():
    axes = {"axes": np.eye(3).tolist(), "points": np.zeros((3, 3)).tolist()}
    for values, parents, message in [
        ({"axes": axes["axes"]}, None, "expected"),
        ({**axes, "colour": 1}, None, "colour"),
        ({**axes, "points": [[0, 0]]}, None, "points: expected 3 rows of 3"),
        ({**axes, "axes": [[0, 0, 1], [0, 0, 0], [1, 0, 0]]}, None, "joint 2 has an axis of length zero"),
        ({**axes, "length": -1}, None, "length is -1"),
        ({"dh_rows": np.zeros((3, 4)).tolist()}, BRANCHED, "serial chains only"),
    ]:
        with one_line(message):
            kinematic_prior_from_json(values, 3, parents)
