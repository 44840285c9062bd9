"""ROS bags: joint states in any order and at any rate become one table; what is wrong is one clear line."""

import sys

import numpy as np
import pytest

from dln_jax.data import checks, schema
from dln_jax.types import InputError

pytest.importorskip("rosbags", reason="rosbags reads bags; it is in the extra [bag]")
from made_bags import state, write_bag

NAMES = ["elbow", "shoulder"]


def motion(t):
    """q, qd and tau of two joints at the time t."""
    return [np.sin(t), np.cos(2 * t)], [np.cos(t), -2 * np.sin(2 * t)], [3 + t, -t]


def rows(times, names=NAMES, *, tau=True):
    return [state(t, names, *(motion(t) if tau else motion(t)[:2])) for t in times]


def test_both_storages_give_the_same_table(tmp_path):
    t = np.arange(20) / 100
    read = [schema.load(write_bag(tmp_path / str(mcap), {"/joint_states": rows(t)}, mcap=mcap)) for mcap in (0, 1)]
    for data in read:
        np.testing.assert_allclose(data.t, t, atol=1e-12)
        for key, expected in zip(("q", "qd", "tau"), zip(*map(motion, t), strict=True), strict=True):
            np.testing.assert_array_equal(getattr(data, key), expected)
        assert data.joint_names.tolist() == NAMES
        assert data.remarks == () and data.estimated == ("qdd",)
    file = next((tmp_path / "1").glob("*.mcap"))
    np.testing.assert_array_equal(schema.load(file).q, read[0].q)
    file = next((tmp_path / "0").glob("*.db3"))
    np.testing.assert_array_equal(schema.load(file).tau, read[0].tau)


def test_names_may_be_shuffled_and_missing_in_some_messages(tmp_path):
    t = np.arange(40) / 100
    made = []
    for number, now in enumerate(t):
        q, qd, tau = motion(now)
        if number % 2:
            made.append(state(now, NAMES[::-1], q[::-1], qd[::-1], tau[::-1]))
        elif number == 10:
            made.append(state(now, NAMES[1:], q[1:], qd[1:], tau[1:]))
        else:
            made.append(state(now, NAMES, q, qd, tau))
    data = schema.load(write_bag(tmp_path / "bag", {"/joint_states": made}))
    kept = np.delete(t, 10)
    np.testing.assert_allclose(data.t, kept, atol=1e-12)
    np.testing.assert_array_equal(data.q, [motion(now)[0] for now in kept])


def test_two_publishers_on_one_topic_are_merged(tmp_path):
    t = np.arange(50) / 100
    made = [state(now, NAMES[:1], *(part[:1] for part in motion(now))) for now in t]
    made += [state(now + 0.003, NAMES[1:], *(part[1:] for part in motion(now + 0.003))) for now in t]
    data = schema.load(write_bag(tmp_path / "bag", {"/joint_states": made}))
    assert len(data.t) == 49  # the shoulder's first message comes after the elbow's
    expected = [motion(now + 0.01)[0] for now in data.t]
    np.testing.assert_allclose(data.q, expected, atol=1e-5)  # cubic splines: an error of fourth order
    assert any(remark.startswith("bag: clock: ") for remark in data.remarks)


def test_topics_of_different_rates_are_put_on_the_slower_clock(tmp_path):
    fast, slow = np.arange(400) / 500, 0.0007 + np.arange(70) / 100
    efforts = [state(t, NAMES[::-1], tau=motion(t)[2][::-1]) for t in slow]
    bag = write_bag(tmp_path / "bag", {"/states": rows(fast, tau=False), "/currents": efforts})
    data = schema.load(bag, topics=["/states", "/currents"], torque_factor={"elbow": 0.5})
    np.testing.assert_allclose(data.t, slow - slow[0], atol=1e-12)
    q, qd, tau = zip(*map(motion, slow), strict=True)
    np.testing.assert_allclose(data.q, q, atol=1e-8)
    np.testing.assert_allclose(data.qd, qd, atol=1e-7)
    np.testing.assert_allclose(data.tau, np.array(tau) * [0.5, 1], atol=1e-12)
    clock, factors = data.remarks
    assert "effort of elbow in /currents, 100 Hz; q and qd by cubic splines" in clock
    assert factors == "tau is that of the log times elbow 0.5, shoulder 1"


def test_gaps_of_one_topic_are_left_out(tmp_path):
    t = np.arange(100) / 100
    efforts = [state(now, NAMES, tau=motion(now)[2]) for now in t if not 0.4 < now < 0.6]
    made = {"/states": rows(t + 0.002, tau=False), "/efforts": efforts}
    data = schema.load(write_bag(tmp_path / "bag", made), topics=["/states", "/efforts"])
    assert np.diff(data.t).max() > 0.19
    expected = [motion(now + 0.01)[2] for now in data.t]
    np.testing.assert_allclose(data.tau, expected, atol=1e-12)
    assert "left out" in data.remarks[0]


def test_repeated_and_reversed_stamps_are_repaired_and_said(tmp_path):
    t = np.arange(30) / 100
    made = rows(t)
    made[5], made[6] = made[6][:-1] + made[5][-1:], made[5][:-1] + made[6][-1:]  # received the other way round
    made.append(state(t[9], NAMES, [9, 9], [9, 9], [9, 9], receipt=t[9] + 0.001))
    data = schema.load(write_bag(tmp_path / "bag", {"/joint_states": made}))
    np.testing.assert_array_equal(data.q, [motion(now)[0] for now in t])
    assert "1 messages repeat a stamp (the first is kept)" in data.remarks[0]
    assert "1 messages are earlier than the one before (sorted by stamp)" in data.remarks[1]
    assert checks.report(checks.examine(checks.as_recording(data)), "bag")[1:3] == list(data.remarks)


@pytest.mark.parametrize("stamped", [True, False])
def test_times_of_receipt_stand_in_for_stamps_that_are_missing_or_set_back(tmp_path, stamped):
    t = np.arange(30) / 100
    made = [state(now - 100 * (now > 0.15), NAMES, *motion(now), receipt=now) for now in t]
    data = schema.load(write_bag(tmp_path / "bag", {"/joint_states": made}, stamped=stamped))
    np.testing.assert_allclose(data.t, t, atol=1e-12)
    assert "times of receipt are used" in data.remarks[0]


def test_joints_are_selected_ordered_and_renamed(tmp_path):
    t = np.arange(20) / 100
    bag = write_bag(tmp_path / "bag", {"/joint_states": rows(t)})
    both = schema.load(bag, joints=["shoulder", "elbow=forearm"])
    assert both.joint_names.tolist() == ["shoulder", "forearm"]
    np.testing.assert_array_equal(both.q, schema.load(bag).q[:, ::-1])
    one = schema.load(bag, joints=["shoulder"])
    assert one.q.shape == (20, 1) and "joints left out: elbow" in one.remarks[0]
    assert schema.load(bag, joints=["shoulder=s"]).joint_names.tolist() == ["elbow", "s"]


def test_joints_beside_a_robots_do_not_slow_its_clock(tmp_path):
    t = np.arange(100) / 100
    made = rows(t) + [state(now, ["finger"], [0.0], [0.0], [0.0]) for now in t[::20]]
    bag = write_bag(tmp_path / "bag", {"/joint_states": made})
    assert len(schema.load(bag).t) == 5
    data = schema.load(bag, robot=("arm_shoulder", "arm_elbow"))
    assert len(data.t) == 100 and data.joint_names.tolist() == ["shoulder", "elbow"]


def test_a_folder_of_bags_is_a_trajectory_each(tmp_path):
    t = np.arange(20) / 100
    for name in ("b", "a"):
        write_bag(tmp_path / name, {"/joint_states": rows(t)}, mcap=name == "a")
    data = schema.load(tmp_path)
    assert data.label.tolist() == ["a", "b"]
    np.testing.assert_array_equal(np.bincount(data.trajectory), [20, 20])
    write_bag(tmp_path / "c", {"/joint_states": rows(t, tau=False)})
    with pytest.raises(InputError, match=r"a and c differ \(tau only in one\)"):
        schema.load(tmp_path)


@pytest.mark.parametrize("value", [None, np.nan, 0.0])
def test_messages_without_efforts_leave_no_torque(tmp_path, value):
    t = np.arange(20) / 100
    made = [state(now, NAMES, *motion(now)[:2], [] if value is None else [value, value]) for now in t]
    data = schema.load(write_bag(tmp_path / "bag", {"/joint_states": made}))
    assert "tau" in data.estimated and "so there is no tau" in data.remarks[0]


def test_bags_that_cannot_be_used_are_refused_in_one_line(tmp_path):
    t = np.arange(20) / 100
    bag = write_bag(tmp_path / "bag", {"/joint_states": rows(t), "/other": rows(t)}, others=["/rosout"])
    empty = write_bag(tmp_path / "empty", {}, others=["/rosout"])
    apart = write_bag(
        tmp_path / "apart", {"/a": rows(t, tau=False), "/b": [state(9 + s, NAMES, tau=[1, 2]) for s in t]}
    )
    uneven = write_bag(tmp_path / "uneven", {"/a": [state(s, NAMES, [1.0, 2.0], [1.0]) for s in t]})
    double = write_bag(tmp_path / "double", {"/a": [state(s, ["elbow", "elbow"], [1.0, 2.0]) for s in t]})
    half = write_bag(tmp_path / "half", {"/a": [state(s, NAMES, *motion(s)[:2], [1.0, np.nan]) for s in t]})
    for name in ("junk.db3", "junk.mcap", "junk.bag"):
        (tmp_path / name).write_bytes(b"no bag at all" * 20)
    (tmp_path / "nothing").mkdir()
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "metadata.yaml").write_text("{")
    for path, stated, words in (
        (bag, {}, "/joint_states, /other have joint states; choose, or combine, by --topics A,B"),
        (bag, {"topics": ["/jointstates"]}, r"topic /jointstates is not in the bag; the bag has /joint_states"),
        (bag, {"topics": ["/rosout"]}, "/rosout has messages std_msgs/msg/String; expected sensor_msgs/msg/JointState"),
        (bag, {"topics": ["/other"], "joints": ["wrist"]}, r"'wrist' is not among the log's joints \(elbow, shoulder"),
        (bag, {"topics": ["/other"], "joints": ["elbow=shoulder"]}, "names a joint twice"),
        (bag, {"topics": ["/other"], "robot": ["wrist", "hip"]}, "robot's joint 'wrist' is not among the data's"),
        (bag, {"topics": ["/other"], "rate": 100}, "the file has t"),
        (bag, {"units": "si"}, "units are for CSV"),
        (bag, {"topics": ["/other"], "torque_factor": (1.0, 2.0, 3.0)}, "has 3 numbers, the log 2 joints"),
        (empty, {}, r"no topic has sensor_msgs/msg/JointState; the bag has /rosout \(std_msgs/msg/String\)"),
        (apart, {"topics": ["/a", "/b"]}, "the messages of /a, /b do not overlap in time"),
        (uneven, {}, "message 1 of /a has 2 names, but velocity of length 1"),
        (double, {}, "message 1 of /a names 'elbow' twice; expected once"),
        (half, {}, "joint 'shoulder' has no efforts, others have; read these alone: --joints elbow"),
        *((tmp_path / f"junk.{kind}", {}, "not a readable ROS bag") for kind in ("db3", "mcap", "bag")),
        (tmp_path / "damaged", {}, "not a readable ROS bag"),
        (tmp_path / "nothing", {}, "the folder has neither metadata.yaml"),
        (tmp_path / "absent.db3", {}, "no such file; give the path of an npz or CSV file, or a ROS bag"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words) as refusal:
            schema.load(path, **stated)
        assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "bag", {"/joint_states": rows(np.arange(9) / 100)})
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(InputError, match=r"takes the package rosbags: pip install 'dln-jax\[bag\]'"):
        schema.load(bag)
