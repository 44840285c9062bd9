"""`excite` writes motions within a robot's limits; what it cannot design for is one line."""

import numpy as np
import pytest
from calls import assert_refused, command, json_of, refused

from dln_jax import read_robot
from dln_jax.commands import excite
from dln_jax.data import schema
from dln_jax.identification.excitation.limits import limits_of_robot

URDF = """<robot name="arm"><link name="base"/>
<link name="one"><inertial><origin xyz="0.2 0.02 0.05"/><mass value="1.5"/>
<inertia ixx="0.03" iyy="0.04" izz="0.02" ixy="0.004" ixz="-0.002" iyz="0.001"/></inertial></link>
<link name="two"><inertial><origin xyz="0.2 0.02 0.05"/><mass value="1.5"/>
<inertia ixx="0.03" iyy="0.04" izz="0.02" ixy="0.004" ixz="-0.002" iyz="0.001"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="one"/>
<origin xyz="0.4 0 0.3" rpy="1.57 0 0"/><axis xyz="0 0 1"/><limit lower="-2" upper="1.5" effort="30" velocity="2.5"/>
<dynamics damping="0.2" friction="0.1"/></joint>
<joint name="elbow" type="continuous"><parent link="one"/><child link="two"/>
<origin xyz="0.4 0 0.3" rpy="1.57 0 0"/><axis xyz="0 0 1"/><limit effort="20" velocity="3"/>
<dynamics damping="0.2" friction="0.1"/></joint></robot>"""


@pytest.fixture
def arm(tmp_path):
    return changed(tmp_path)


def changed(folder, old="", new=""):
    """The robot's file with a change."""
    (folder / "arm.urdf").write_text(URDF.replace(old, new))
    return folder / "arm.urdf"


QUICK = "--harmonics 3 --seconds 6 --trajectories 1 --starts 1"


def test_a_folder_with_motions(arm, tmp_path, capsys):
    out = tmp_path / "run"
    options = "--payload 0.5 --payload-position 0.1,0,0 --height -0.2 --allow-unlimited elbow --rate 50"
    command(excite, "--robot", arm, "--out", out, QUICK, options)
    assert "no limits of position for elbow: pi to either side is assumed" in capsys.readouterr().out
    data = schema.load(out / "excitation.npz")
    assert data.label.tolist() == ["train-1", "validation"] and len(data.t) == 2 * 301
    assert np.abs(data.qd[data.t == 0.0]).max() < 1e-12
    assert (np.abs(data.qd) <= [0.9 * 2.5, 0.9 * 3.0]).all() and (np.abs(data.tau) <= [27.0, 18.0]).all()
    assert (np.abs(data.q[:, 0] + 0.25) <= 0.9 * 1.75).all() and (np.ptp(data.qd, axis=0) > 2).all()
    assert schema.load(out / "train-1.csv").q == pytest.approx(data.q[data.trajectory == 0], abs=1e-9)
    metrics = json_of(out / "metrics.json")
    assert metrics["standard_error_ratio_median"] < 1 and metrics["least_slack"] > 0
    series = json_of(out / "motions.json")["motions"]["validation"]
    assert np.shape(series["sines"]) == (2, 3) and (out / "excitation.png").is_file()


def test_bad_input_is_one_line(arm, tmp_path, capsys):
    rows = [
        ("--seconds 0", "seconds is 0"),
        ("--harmonics 1", "harmonics is 1"),
        ("--harmonics 40 --rate 4", "half the sampling rate"),
        ("--robot nowhere.urdf", "nowhere.urdf"),
        ("--velocity 1,2,3", "--velocity is '1,2,3'; expected 1 or 2 positive numbers"),
        ("--torque strong", "--torque is 'strong'"),
        ("--share 2", "share is 2"),
        ("--payload-position 0,1 --payload 1", "expected 3 numbers"),
        ("--velocity-scale 0", "velocity_scale is 0"),
        ("--allow-unlimited shoulder", "joint 'elbow' has no limit of position: state it (--position"),
        ("--allow-unlimited", "shoulder, wrist", "no joint matches 'wrist' of --allow-unlimited"),
    ]
    assert_refused(capsys, excite, rows, "--allow-unlimited * --robot", arm, out=tmp_path / "run")


def test_joint_without_a_limit_is_refused_unless_allowed(tmp_path, capsys):
    path = changed(tmp_path, 'velocity="2.5"', 'velocity="0"')
    line = refused(capsys, excite, "--allow-unlimited * --robot", path)
    assert "joint 'shoulder' has no limit of velocity" in line
    for effort in ("", 'effort="0"', 'effort="inf"'):
        changed(tmp_path, 'effort="30"', effort)
        line = refused(capsys, excite, "--allow-unlimited elbow --robot", path)
        assert "joint 'shoulder' has no limit of force: state it (--torque" in line
        limits, said = limits_of_robot(read_robot(path), allow_unlimited=["shoulder", "el*"])
        assert "no limits of force for shoulder" in said[-1] and np.isinf(limits.force[0]).all()


def test_limits_of_a_file(arm):
    stated = {"acceleration": [4.0, 5.0], "force": 12.0, "allow_unlimited": ["elbow"]}
    robot = read_robot(arm)
    limits, said = limits_of_robot(robot, **stated)
    assert len(said) == 1 and np.allclose(limits.position, [[-2.0, 1.5], [-np.pi, np.pi]])
    assert np.allclose(robot.velocity_limits, [2.5, 3.0])
    assert np.allclose(limits.acceleration, [4.0, 5.0]) and np.allclose(limits.force, [[-12.0, 12.0]] * 2)
