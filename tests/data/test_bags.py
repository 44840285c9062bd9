"""ROS bags: joint states in any order and at any rate become one table; what is wrong is one clear line."""

import itertools
import sys

import numpy as np
import pytest
from calls import one_line
from made_bags import state, write_bag
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax.data import schema

NAMES = ["elbow", "shoulder"]
T = np.arange(40) / 100


def motion(t):
    """q, qd and tau of two joints at the time t."""
    return [np.sin(t), np.cos(2 * t)], [np.cos(t), -2 * np.sin(2 * t)], [3 + t, -t]


def table(times):
    """q, qd and tau [T, 2] of the motion."""
    return (np.array(part).T for part in motion(times))


def rows(times=T, names=NAMES, *, joints=slice(None), tau=True):
    """Messages of the joints of a slice."""
    return [state(t, names[joints], *(part[joints] for part in motion(t)[: 2 + tau])) for t in times]


@pytest.fixture
def bag(tmp_path):
    """Writes a bag of topics, or of /joint_states alone."""
    numbers = itertools.count()

    def written(made, **options):
        topics = made if isinstance(made, dict) else {"/joint_states": made}
        return write_bag(tmp_path / f"bag{next(numbers)}", topics, **options)

    return written


def test_both_storages_give_the_same_table(bag):
    for mcap, pattern in ((False, "*.db3"), (True, "*.mcap")):
        folder = bag(rows(), mcap=mcap)
        for path in (folder, next(folder.glob(pattern))):
            data = schema.load(path)
            assert_allclose(data.t, T, atol=1e-12)
            for ours, expected in zip((data.q, data.qd, data.tau), table(T), strict=True):
                assert_array_equal(ours, expected)
            assert data.joint_names.tolist() == NAMES
            assert data.remarks == () and data.estimated == ("qdd",)


def test_names_may_be_shuffled_and_missing_in_some_messages(bag):
    made = rows()
    made[1::2] = rows(T[1::2], joints=slice(None, None, -1))
    made[10:11] = rows(T[10:11], joints=slice(1, 2))
    data = schema.load(bag(made))
    assert_allclose(data.t, np.delete(T, 10), atol=1e-12)
    assert_array_equal(data.q, next(table(np.delete(T, 10))))


def test_two_publishers_on_one_topic_are_merged(bag):
    data = schema.load(bag(rows(joints=slice(1)) + rows(T + 0.003, joints=slice(1, 2))))
    assert len(data.t) == 39  # the shoulder's first message comes after the elbow's
    assert_allclose(data.q, next(table(data.t + 0.01)), atol=1e-5)  # cubic splines: of fourth order
    assert any(": clock: " in remark for remark in data.remarks)


def test_topics_of_different_rates_are_put_on_the_slower_clock(bag):
    fast, slow = np.arange(400) / 500, 0.0007 + np.arange(70) / 100
    efforts = [state(t, NAMES[::-1], tau=motion(t)[2][::-1]) for t in slow]
    path = bag({"/states": rows(fast, tau=False), "/currents": efforts})
    data = schema.load(path, topics=["/states", "/currents"], torque_factor={"elbow": 0.5})
    assert_allclose(data.t, slow - slow[0], atol=1e-12)
    q, qd, tau = table(slow)
    assert_allclose([data.q, data.qd], [q, qd], atol=1e-7)
    assert_allclose(data.tau, tau * [0.5, 1], atol=1e-12)
    assert "effort of elbow in /currents, 100 Hz; q and qd by cubic splines" in data.remarks[0]
    assert data.remarks[1] == "tau of the log is multiplied by elbow 0.5, shoulder 1"


def test_gaps_of_one_topic_are_left_out(bag):
    efforts = [state(now, NAMES, tau=motion(now)[2]) for now in T if not 0.1 < now < 0.3]
    path = bag({"/states": rows(T + 0.002, tau=False), "/efforts": efforts})
    data = schema.load(path, topics=["/states", "/efforts"])
    assert np.diff(data.t).max() > 0.19 and "left out" in data.remarks[0]
    assert_allclose(data.tau, [*table(data.t + 0.01)][2], atol=1e-12)


def test_repeated_and_reversed_stamps_are_repaired_and_said(bag):
    made = rows()
    made[5], made[6] = made[6][:-1] + made[5][-1:], made[5][:-1] + made[6][-1:]  # received the other way round
    made.append(state(T[9], NAMES, [9, 9], [9, 9], [9, 9], receipt=T[9] + 0.001))
    data = schema.load(bag(made))
    assert_array_equal(data.q, next(table(T)))
    assert "1 messages repeat a stamp (the first is kept)" in data.remarks[0]
    assert "1 messages are earlier than the one before (sorted by stamp)" in data.remarks[1]


def test_times_of_receipt_stand_in_for_stamps_that_are_missing_or_set_back(bag):
    made = [state(now - 100 * (now > 0.15), NAMES, *motion(now), receipt=now) for now in T]
    for stamped in (True, False):
        data = schema.load(bag(made, stamped=stamped))
        assert_allclose(data.t, T, atol=1e-12)
        assert "times of receipt are used" in data.remarks[0]


def test_joints_are_selected_ordered_and_renamed(bag):
    path = bag(rows() + [state(now, ["finger"], [0.0], [0.0], [0.0]) for now in T[::10]])
    assert len(schema.load(path).t) == 4
    data = schema.load(path, robot=("arm_shoulder", "arm_elbow"))  # whose clock another joint does not slow
    assert len(data.t) == 40 and data.joint_names.tolist() == ["shoulder", "elbow"]
    both = schema.load(path, joints=["shoulder", "elbow=forearm"])
    assert both.joint_names.tolist() == ["shoulder", "forearm"]
    assert_array_equal(both.q, data.q)
    assert "joints left out: finger" in both.remarks[0]


def test_a_folder_of_bags_is_a_trajectory_each(bag, tmp_path):
    bag(rows()), bag(rows(), mcap=True)
    data = schema.load(tmp_path)
    assert data.label.tolist() == ["bag0", "bag1"]
    assert_array_equal(np.bincount(data.trajectory), [40, 40])
    bag(rows(tau=False))
    with one_line(r"bag0 and bag2 differ \(tau only in one\)"):
        schema.load(tmp_path)


def test_messages_without_efforts_leave_no_torque(bag):
    for efforts in ([], [np.nan, np.nan], [0.0, 0.0]):
        data = schema.load(bag([state(now, NAMES, *motion(now)[:2], efforts) for now in T]))
        assert "tau" in data.estimated and "so there is no tau" in data.remarks[0]


def test_bags_that_cannot_be_used_are_refused_in_one_line(bag, tmp_path, monkeypatch):
    two = bag({"/joint_states": rows(), "/other": rows()}, others=["/rosout"])
    apart = {"/a": rows(tau=False), "/b": [state(9 + s, NAMES, tau=[1, 2]) for s in T]}
    (tmp_path / "nothing").mkdir()
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged/metadata.yaml").write_text("{")
    for kind in ("db3", "mcap", "bag"):
        (tmp_path / f"junk.{kind}").write_bytes(b"no bag at all" * 20)
    other = {"topics": ["/other"]}
    for path, stated, words in (
        (two, {}, "/joint_states, /other have joint states; choose, or combine, by --topics A,B"),
        (two, {"topics": ["/jointstates"]}, r"topic /jointstates is not in the bag; the bag has /joint_states"),
        (two, {"topics": ["/rosout"]}, "/rosout has messages std_msgs/msg/String; expected sensor_msgs/msg/JointState"),
        (two, {**other, "joints": ["wrist"]}, r"'wrist' is not a joint of the log \(elbow, shoulder"),
        (bag({}, others=["/rosout"]), {}, r"no topic has .*JointState; the bag has /rosout \(std_msgs/msg/String\)"),
        (bag(apart), {"topics": ["/a", "/b"]}, "the messages of /a, /b do not overlap in time"),
        (bag([state(0, NAMES, [1.0, 2.0], [1.0])]), {}, "message 1 of .* has 2 names, but velocity of length 1"),
        (bag([state(0, ["elbow"] * 2, [1.0, 2.0])]), {}, "message 1 of .* names 'elbow' twice; expected once"),
        (
            bag([state(s, NAMES, *motion(s)[:2], [1.0, np.nan]) for s in T]),
            {},
            "joint 'shoulder' has no efforts, others have; read these alone: --joints elbow",
        ),
        *((tmp_path / name, {}, "not a readable ROS bag") for name in ("junk.db3", "junk.mcap", "junk.bag", "damaged")),
        (tmp_path / "nothing", {}, "the folder has neither metadata.yaml"),
    ):
        with one_line(words) as refusal:
            schema.load(path, **stated)
        assert str(path) in str(refusal.value)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with one_line(r"needs the package rosbags: pip install 'dln-jax\[bag\]'"):
        schema.load(two)
