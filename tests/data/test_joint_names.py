"""Joint names of logs: renamed, selected, and matched with a robot's where one replacement explains all."""

import numpy as np
from calls import one_line
from numpy.testing import assert_array_equal

from dln_jax.data import schema
from dln_jax.data.joints import match_names, scale_torques, select_names
from dln_jax.data.splits import in_blocks, with_joints

ARRAYS = {
    "t": np.arange(6.0),
    "q": np.random.default_rng(0).normal(size=(6, 2)),
    "trajectory": np.zeros(6, int),
    "tau": np.random.default_rng(1).normal(size=(6, 2)),
    "needs": np.array('{"joints": ["revolute", "prismatic"]}'),
}
NAMED = schema.from_arrays({**ARRAYS, "joint_names": np.array(["elbow", "slide"])})


def test_names_match_if_one_prefix_or_ending_is_replaced():
    for own, wanted, expected in (
        (["panda_j1", "panda_j2", "panda_finger_j1"], ["fer_j1", "fer_j2"], ["panda_j1", "panda_j2"]),
        (["elbow", "shoulder"], ["shoulder_joint", "elbow_joint"], ["shoulder", "elbow"]),
        (["elbow_a", "hip_a"], ["ur/hip_a", "ur/elbow_a"], ["hip_a", "elbow_a"]),
        (["A1", "A2"], ["joint_a1", "joint_a2"], ["A1", "A2"]),
        (["j1", "j11", "j12"], ["j1", "j11"], ["j1", "j11"]),
    ):
        assert list(match_names(own, wanted).values()) == expected


def test_statements_about_joints_are_checked():
    assert select_names(["a", "b", "c"], ["c", "a=x"]) == {"c": "c", "a": "x"}
    arrays = {"tau": np.ones((1, 2)), "joint_names": ["a", "b"]}
    assert scale_torques(arrays, {"b": -2})["tau"].tolist() == [[1.0, -2.0]]
    three, arms = ["a", "b", "c"], ["left_elbow", "left_wrist", "right_elbow", "right_wrist"]
    for call, words in (
        (lambda: select_names(three, ["d"]), "'d' is not a joint"),
        (lambda: select_names(three, ["a="]), "lacks a name"),
        (lambda: select_names(three, ["a", "a"]), "names a joint twice"),
        (lambda: scale_torques(arrays, 0.0), "zero"),
        (lambda: match_names(["elbow", "hip"], ["knee", "hip"]), r"'knee' is not in the data \(elbow, hip\)"),
        (
            lambda: match_names(arms, ["elbow", "wrist"]),
            r"more than one way \(left_elbow=elbow, .*; right_elbow=elbow",
        ),
        (lambda: with_joints(NAMED, ("elbow", "slide", "wrist")), "have 2 joints, the robot 3"),
        (lambda: with_joints(NAMED, ("elbow", "wrist")), "'wrist' is not in the data"),
        (lambda: in_blocks(NAMED, 7), "has 6 samples, too few for 7"),
    ):
        with one_line(words):
            call()


def test_columns_take_the_robots_order():
    ordered = with_joints(NAMED, ("slide", "elbow"))
    for key in ("q", "qd", "qdd", "tau"):
        assert_array_equal(getattr(ordered, key), getattr(NAMED, key)[:, ::-1])
    assert ordered.joint_names.tolist() == ["slide", "elbow"] and ordered.needs.joints == ("prismatic", "revolute")
    unnamed = schema.from_arrays(ARRAYS)
    assert with_joints(unnamed, ("a", "b")) is unnamed


def test_files_with_names_are_matched_and_say_so(tmp_path):
    path = tmp_path / "log.npz"
    t = np.arange(5) / 10
    q = np.stack([t, 2 * t, 3 * t], axis=1)
    np.savez(path, t=t, q=q)
    for stated, words in (
        ({"joints": ["a"]}, "--joints needs joint names"),
        ({"torque_factor": 2.0}, "scales tau, but the file has no tau"),
        ({"topics": ["/a"]}, "--topics is for ROS bags"),
    ):
        with one_line(words):
            schema.load(path, **stated)
    np.savez(path, t=t, q=q, tau=q, joint_names=np.array(["panda_2", "panda_1", "grip"]))
    data = with_joints(schema.load(path), ("fer_1", "fer_2"))
    assert_array_equal(data.q, q[:, [1, 0]])
    assert data.joint_names.tolist() == ["fer_1", "fer_2"]
    assert data.remarks == (
        "joints matched by name: panda_1=fer_1, panda_2=fer_2",
        "not joints of the robot, left out: grip (moved by 1.2)",
    )
    doubled = schema.load(path, joints=["grip", "panda_2=two"], torque_factor=2)
    assert_array_equal(doubled.tau, 2 * q[:, [2, 0]])
