"""Joint names of logs: renamed, selected, and matched with a robot's where one replacement explains all."""

import numpy as np
import pytest

from dln_jax.data import schema
from dln_jax.data.joint_names import chosen, factors, matched
from dln_jax.data.splits import with_joints
from dln_jax.types import InputError

PANDA = [*(f"panda_joint{k}" for k in range(1, 8)), "panda_finger_joint1", "panda_finger_joint2"]


@pytest.mark.parametrize(
    ("own", "wanted", "expected"),
    [
        (PANDA, [f"fer_joint{k}" for k in range(1, 8)], PANDA[:7]),
        (["elbow", "shoulder"], ["shoulder_joint", "elbow_joint"], ["shoulder", "elbow"]),
        (["elbow_joint", "shoulder_joint"], ["ur/shoulder_joint", "ur/elbow_joint"], ["shoulder_joint", "elbow_joint"]),
        (["A1", "A2"], ["joint_a1", "joint_a2"], ["A1", "A2"]),
        (["j1", "j11", "j12"], ["j1", "j11"], ["j1", "j11"]),
    ],
)
def test_names_match_if_one_prefix_or_ending_is_replaced(own, wanted, expected):
    assert list(matched(own, wanted).values()) == expected


def test_names_that_match_in_no_way_or_in_two_are_refused():
    with pytest.raises(InputError, match=r"'knee' is not among the data's \(elbow, shoulder\); state them: --joints"):
        matched(["elbow", "shoulder"], ["knee", "hip"])
    arms = ["left_elbow", "left_wrist", "right_elbow", "right_wrist"]
    with pytest.raises(InputError, match=r"in more than one way \(left_elbow=elbow, .*; right_elbow=elbow"):
        matched(arms, ["elbow", "wrist"])


def test_statements_about_joints_are_checked():
    assert chosen(["a", "b", "c"], ["c", "a=x"]) == (("c", "a"), ("c", "x"))
    for stated, words in ((["d"], "'d' is not among"), (["a="], "lacks a name"), (["a", "a"], "names a joint twice")):
        with pytest.raises(InputError, match=words):
            chosen(["a", "b", "c"], stated)
    assert factors({"b": -2}, ["a", "b"]) == [1.0, -2.0]
    with pytest.raises(InputError, match="zero"):
        factors(0.0, ["a"])


def test_files_with_names_are_matched_and_say_so(tmp_path):
    t = np.arange(5) / 10
    q = np.stack([t, 2 * t, 3 * t], axis=1)
    names = np.array(["panda_2", "panda_1", "grip"])
    np.savez(tmp_path / "log.npz", t=t, q=q, tau=q, joint_names=names)
    data = with_joints(schema.load(tmp_path / "log.npz"), ("fer_1", "fer_2"))
    np.testing.assert_array_equal(data.q, q[:, [1, 0]])
    assert data.joint_names.tolist() == ["fer_1", "fer_2"]
    assert data.remarks == (
        "joints matched by name: panda_1=fer_1, panda_2=fer_2",
        "not joints of the robot, left out: grip (moved by 1.2)",
    )
    chosen_ones = schema.load(tmp_path / "log.npz", joints=["grip", "panda_2=two"], torque_factor=2)
    np.testing.assert_array_equal(chosen_ones.tau, 2 * q[:, [2, 0]])
    text = "t [s],q left [rad],q right [rad]\n0,1,2\n1,2,3\n2,3,5\n"
    (tmp_path / "log.csv").write_text(text)
    np.testing.assert_array_equal(schema.load(tmp_path / "log.csv", joints=["right"]).q[:, 0], [2, 3, 5])
    np.savez(tmp_path / "plain.npz", t=t, q=q)
    for stated, words in (
        ({"joints": ["a"]}, "--joints needs the joints' names"),
        ({"torque_factor": 2.0}, "scales tau, which the file lacks"),
        ({"topics": ["/a"]}, "--topics is for ROS bags"),
    ):
        with pytest.raises(InputError, match=words):
            schema.load(tmp_path / "plain.npz", **stated)
