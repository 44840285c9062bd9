"""A ROS bag whose joints have other names than the URDF, by `check_data`."""

import numpy as np
import pytest
from calls import assert_refused, exit_status
from made_bags import state, write_bag

from dln_jax.commands import check_data

URDF = """<robot name="arm"><link name="base"/>
<link name="shoulder"><inertial><origin xyz="0.2 0.02 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="elbow"><inertial><origin xyz="0.2 0.02 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="fer_shoulder" type="continuous"><parent link="base"/><child link="shoulder"/><axis xyz="0 1 0"/></joint>
<joint name="fer_elbow" type="continuous"><parent link="shoulder"/><child link="elbow"/>
<origin xyz="0.5 0 0"/><axis xyz="0 1 0"/></joint></robot>"""
LOG = "--data motion --robot arm.urdf --topics /joint_states,/currents --torque-factor 0.5"


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A URDF, and a bag: states at 250 Hz, currents at 100 Hz, a gripper beside them."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.urdf").write_text(URDF)
    names = ["panda_elbow", "panda_shoulder", "panda_finger"]
    wave = lambda t: np.array([np.sin(3 * t), np.cos(2 * t), 0.02])  # noqa: E731
    states = [state(t, names, wave(t), wave(t + 1)) for t in np.arange(0, 4, 0.004)]
    currents = [state(t, names[1::-1], tau=wave(2 * t)[:2]) for t in np.arange(0.0013, 3.9, 0.01)]
    write_bag(tmp_path / "motion", {"/joint_states": states, "/currents": currents}, mcap=True, others=["/rosout"])
    return tmp_path


def test_a_bag_is_examined_beside_the_robot(place, capsys):
    exit_status(check_data, LOG, "--no-figures --out check")  # these motions are not the robot's
    said = capsys.readouterr().out
    assert "joints matched by name: panda_shoulder=fer_shoulder, panda_elbow=fer_elbow" in said
    assert "joints left out: panda_finger" in said and "100 Hz; q and qd by cubic splines" in said
    assert "by panda_shoulder 0.5" in said
    rows = {
        "--topics /joint_states": "no efforts in the messages",
        "--joints panda_elbow,panda_finger": "the robot's joint 'fer_shoulder' is not in the data",
        "--torque-factor fer_elbow=2": "'fer_elbow' is not a joint of the log (panda_shoulder, panda_elbow)",
        "--torque-factor panda_elbow=1,panda_elbow=2": "--torque-factor names 'panda_elbow' twice",
        "--torque-factor much": "--torque-factor is 'much'; expected finite numbers",
    }
    # The last of an option that is given twice counts.
    assert_refused(capsys, check_data, rows.items(), LOG, out=place / "none")
