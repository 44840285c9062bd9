"""Data whose joints have names take the robot's order; blocks of time are trajectories of their own."""

import numpy as np
import pytest

from dln_jax.data.schema import from_arrays, load, save
from dln_jax.data.splits import in_blocks, with_joints
from dln_jax.types import InputError

ARRAYS = {
    "t": np.arange(6.0),
    "q": np.random.default_rng(0).normal(size=(6, 2)),
    "trajectory": np.zeros(6, int),
    "tau": np.random.default_rng(1).normal(size=(6, 2)),
    "needs": np.array('{"joints": ["revolute", "prismatic"]}'),
}
NAMED = from_arrays({**ARRAYS, "joint_names": np.array(["elbow", "slide"])})


def test_columns_take_the_robots_order(tmp_path):
    save(tmp_path / "log.npz", NAMED)
    data = load(tmp_path / "log.npz")
    ordered = with_joints(data, ("slide", "elbow"))
    for key in ("q", "qd", "qdd", "tau"):
        np.testing.assert_array_equal(getattr(ordered, key), getattr(data, key)[:, ::-1])
    assert ordered.joint_names.tolist() == ["slide", "elbow"] and ordered.needs.joints == ("prismatic", "revolute")
    unnamed = from_arrays(ARRAYS)
    assert with_joints(unnamed, ("a", "b")) is unnamed


def test_other_joints_are_refused():
    for data, names, message in (
        (from_arrays(ARRAYS), ("elbow",), "have 2 joints, the robot 1"),
        (NAMED, ("elbow", "slide", "wrist"), "have 2 joints, the robot 3"),
        (NAMED, ("elbow", "wrist"), "'wrist' is not among"),
    ):
        with pytest.raises(InputError, match=message):
            with_joints(data, names)
    for names in (np.array(["a"]), np.array(["a", "a"]), np.array([1, 2])):
        with pytest.raises(InputError, match="expected 2 different strings"):
            from_arrays({**ARRAYS, "joint_names": names})


def test_blocks_of_time():
    blocks = in_blocks(NAMED, 3)
    assert blocks.label.tolist() == ["0[0]", "0[1]", "0[2]"]
    np.testing.assert_array_equal(blocks.trajectory, [0, 0, 1, 1, 2, 2])
    np.testing.assert_array_equal(blocks.qdd, NAMED.qdd)
    with pytest.raises(InputError, match="has 6 samples; expected at least 7"):
        in_blocks(NAMED, 7)
