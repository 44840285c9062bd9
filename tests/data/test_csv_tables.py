"""CSV logs: columns in any order, units that are stated and converted, and one clear line for what is malformed."""

import jax
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax.data import csv_tables, schema
from dln_jax.data.checks.report import read
from dln_jax.data.csv_tables import write_motion
from dln_jax.data.splits import select_samples

ROWS = "0,1,2,3,4\n0.1,5,6,7,8\n0.2,9,10,11,12\n"
HEADER = "t [s],q1 [rad],q2 [rad],tau1 [N m],tau2 [N m]\n"


@pytest.fixture
def load(tmp_path):
    """Text of a file -> the trajectories in it."""

    def loaded(text, **stated):
        path = tmp_path / "log.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return schema.load(path, **stated)

    return loaded


def test_columns_come_in_any_order_as_the_arrays_of_an_npz_file(load, tmp_path):
    arrays = {"t": [0, 0.1, 0.2], "q": [[1, 2], [5, 6], [9, 10]], "tau": [[3, 4], [7, 8], [11, 12]]}
    np.savez(tmp_path / "log.npz", **arrays)
    plain = load(HEADER + ROWS)
    for one, other in zip(plain, schema.load(tmp_path / "log.npz"), strict=True):
        assert_array_equal(one, other)
    shuffled = load("tau2_Nm,note,q2_rad,q1_rad,t_s,tau1_Nm\n4,fine,2,1,0,3\n8,,6,5,0.1,7\n12,a b,10,9,0.2,11\n")
    jax.tree.map(assert_array_equal, shuffled._replace(remarks=()), plain)
    assert read(tmp_path / "log.csv")[0].remarks == shuffled.remarks == ("not read: note",)


def test_every_column_that_is_not_read_is_named(load):
    data = load("t [s],q1 [rad],torque1,effort1 [N m]\n0,1,2,3\n0.1,5,6,7\n0.2,9,10,11\n")
    assert "tau" in data.estimated and data.remarks == ("not read: torque1, effort1 [N m]",)
    titles = ",".join(f"spare{k}" for k in range(100))
    (remark,) = load(f"t [s],q1 [rad],{titles}\n" + "".join(f"{k},1{',0' * 100}\n" for k in range(3))).remarks
    assert remark.endswith("...") and len(remark) < 220


def test_units_in_titles_are_converted_to_si(load):
    degrees = (1e-3, *[np.pi / 180] * 3, 1e-3)
    for titles, factors in (
        ("t [ms],q1 [deg],qd1 [deg/s],qdd1 [deg/s^2],tau1 [mN m]", degrees),
        ("t_ms,q_1_deg,qd_1_deg_s,qdd_1_deg_s2,tau_1_mNm", degrees),
        ("time (s),q (mm),qd (mm/s),qdd (mm/s²),tau (N)", (1, *[1e-3] * 3, 1)),
        ("t [us],q[1] [°],qd[1] [rpm],qdd[1] [rad/s**2],tau[1] [kN·m]", (1e-6, np.pi / 180, np.pi / 30, 1, 1e3)),
        ('"t [s]","q1 [cm]",qd1 [m per s],qdd1 [m/s2],tau1 [N]', (1, 1e-2, 1, 1, 1)),
    ):
        data = load("\ufeff" + titles + "\r\n1,2,3,4,5\r\n\r\n2,4,6,8,10\r\n")
        columns = [data.t, *(getattr(data, key)[:, 0] for key in ("q", "qd", "qdd", "tau"))]
        assert_allclose(columns, np.outer(factors, [1, 2]) * np.arange(1, 6)[:, None], rtol=1e-15)


def test_units_that_no_title_states_are_asked_for(load):
    text = "t,q1,tau1\n0,90,1\n1,180,1\n2,180,1\n"
    with one_line(r"'t' has no unit; .* 't \[s\]', or give --units si"):
        load(text)
    assert load(text, units="si").q[0, 0] == 90
    data = load(text, units="degrees")
    assert_allclose(data.q[:, 0], [np.pi / 2, np.pi, np.pi])
    assert_array_equal(data.tau, 1)


def test_radians_are_not_read_as_degrees(load):
    rows = "0,1.5,-3\n1,6.2,1\n2,0.5,0\n"
    with one_line(r"q reaches only 6\.2, which looks like radians; give --units si, or"):
        load("t,q1,q2\n" + rows, units="degrees")
    # A unit in the title is the way out, and one joint that is beyond a turn decides for all.
    assert_allclose(load("t,q1 [deg],q2 [deg]\n" + rows, units="degrees").q[0, 0], np.deg2rad(1.5))
    assert_allclose(load("t,q1,q2\n" + rows + "3,2,7\n", units="degrees").q[0, 0], np.deg2rad(1.5))


def test_planned_motions_are_read_back_as_they_were_written(tmp_path):
    q, qd = np.random.default_rng(0).normal(size=(2, 5, 2))
    write_motion(
        tmp_path / "m.csv", np.arange(5.0), q, qd, names=("left arm", "lift"), joints=("revolute", "prismatic")
    )
    data = schema.load(tmp_path / "m.csv")
    assert_allclose([data.q, data.qd], [q, qd], rtol=1e-8)
    assert data.joint_names.tolist() == ["left_arm", "lift"]


def test_times_come_from_a_rate_and_recordings_from_their_column(load):
    data = load("q1 [rad],trajectory\n" + "0,4\n1,4\n2,4\n3,7\n4,7\n5,7\n", rate=10)
    assert_allclose(data.t, [0, 0.1, 0.2] * 2)
    assert data.label.tolist() == ["4", "7"]


SEVEN = HEADER + ROWS
MALFORMED = (
    ("", "the file is empty"),
    (HEADER, "no samples below its header"),
    (ROWS, "the first line holds numbers"),
    (SEVEN + "0.3,1,2,3\n", "line 5 has 4 values, the header 5 titles"),
    (HEADER + "0,1,1,2,5,3,4\n", "line 2 has 7 values, the header 5 titles; decimals take a point"),
    (HEADER + '0,"1,5",2,3,4\n', r"line 2: 'q1 \[rad\]' is '1,5'; expected a number"),
    (SEVEN.replace(",", ";"), "separated by semicolons"),
    (SEVEN.replace("7", ""), r"line 3: 'tau1 \[N m\]' is empty"),
    (SEVEN.replace("7", "7_0"), r"'tau1 \[N m\]' is '7_0'"),  # which Python reads as 70
    (SEVEN.replace("7", "1e999"), "tau has 1 NaN or infinite value"),
    ("t [s],x [rad]\n0,1\n", r"key 'q' is missing.*not read: x \[rad\]"),
    ("q1 [rad]\n0\n1\n2\n", "key 't' is missing; add the time of each sample in seconds, or give --rate HZ"),
    ("t [s],q1 [rad],q1 [rad]\n0,1,2\n", r"two columns have the title 'q1 \[rad\]'"),
    ("t [s],q1 [rad],q1 [deg]\n0,1,2\n", r"'q1 \[rad\]' and 'q1 \[deg\]' are the same column"),
    ("t [s],,q1 [rad]\n0,1,2\n", "column 2 has no title"),
    ("t [s],q1 [rad],q2 [rad],tau1 [N m]\n0,1,2,3\n", "no column 'tau2'"),
    ("t [s],q1 [rad],tau1 [N m],tau2 [N m]\n0,1,2,3\n", "no column 'q2'"),
    ("t [s],q1 [rad],tau1 [MN m]\n0,1,2\n", r"'tau1 \[MN m\]' has an unknown unit"),  # not milli
    ("t_s,q1_rad,tau1_MNm\n0,1,2\n", "there is no column 'q1_MNm'|tau1_MNm"),
    ("t [s],q1 [rad],qd1 [rad]\n0,1,2\n", r"'qd1 \[rad\]' has an unknown unit"),
    (b"\xff\xfe\x00t\x00,", "not a text file in UTF-8"),
    (HEADER.encode() + b"\x00\x00,1,2,3,4\n", "line"),
    (HEADER + f'"{"x" * 200_000}",1,2,3,4\n', "line 2 is not CSV"),
)


def test_what_is_malformed_is_one_line(load, tmp_path):
    for text, message in MALFORMED:
        with one_line(message) as refusal:
            load(text)
        assert "log.csv: " in str(refusal.value) and len(str(refusal.value)) < 400
    for text, stated, message in (
        (SEVEN, {"rate": 100}, "the file has t, so its rate is known"),
        ("q1 [rad]\n0\n1\n2\n", {"rate": -1}, "rate is -1"),
        (SEVEN, {"units": "inches"}, "units is 'inches'"),
    ):
        with one_line(message):
            load(text, **stated)
    with one_line("units are for CSV"):
        schema.load(tmp_path / "log.npz", units="si")


def test_a_huge_file_is_refused_before_it_is_read(load, monkeypatch):
    monkeypatch.setattr(csv_tables, "MOST_BYTES", 40)
    with one_line("store it as npz"):
        load(HEADER + ROWS)


def test_temperatures_are_one_column_or_one_for_each_joint(load):
    rows = "0,1,2,20,30\n0.1,5,6,21,31\n0.2,9,10,22,32\n"
    each_joint = load("t [s],q1 [rad],q2 [rad],temperature1 [°C],temperature2_C\n" + rows)
    assert_array_equal(each_joint.temperature, [[20, 30], [21, 31], [22, 32]])
    assert_array_equal(select_samples(each_joint, np.array([2])).temperature, [[22, 32]])
    common = load("t [s],q1 [rad],q2 [rad],temperature [C],other\n" + rows)
    assert_array_equal(common.temperature, [[20, 20], [21, 21], [22, 22]])
