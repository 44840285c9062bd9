"""From a ROS bag whose joints have other names than the URDF to a verdict and C, in three commands."""

import numpy as np
import pytest
from calls import assert_refused, command, json_of

from dln_jax.cli.commands import check_data, export_c, identify
from dln_jax.data.robots import read_robot
from dln_jax.export import load_c
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees import tree_system
from dln_jax.public import dynamics
from dln_jax.zoo.run import load

pytest.importorskip("mujoco", reason="MuJoCo reads the robot files; it is in the extra [robot]")
pytest.importorskip("rosbags", reason="rosbags reads bags; it is in the extra [bag]")
import jax
from made_bags import state, write_bag
from motions import sums_of_sines

URDF = """<robot name="arm"><link name="base"/>
<link name="shoulder"><inertial><origin xyz="0.2 0.02 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="elbow"><inertial><origin xyz="0.2 0.02 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="fer_shoulder" type="continuous"><parent link="base"/><child link="shoulder"/><axis xyz="0 1 0"/></joint>
<joint name="fer_elbow" type="continuous"><parent link="shoulder"/><child link="elbow"/>
<origin xyz="0.5 0 0"/><axis xyz="0 1 0"/></joint></robot>"""
KT = 0.5
"""N m per A: the bag has currents."""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A URDF with half of the true masses, and a bag: states at 250 Hz, currents at 100 Hz, a gripper beside them."""
    folder = tmp_path_factory.mktemp("robot")
    (folder / "arm.urdf").write_text(URDF)
    tree = read_robot(folder / "arm.urdf").tree
    friction = joint_dissipation([0.3, 0.1], [0.3, 0.1], velocity_scale=0.05)
    true = tree_system(tree._replace(inertias=2 * tree.inertias, armature=np.array([0.1, 0.05])), friction)
    random = np.random.default_rng(0)
    sines = random.uniform([0.2, 1, 0], [0.8, 4, 6], (2, 3, 3)).transpose(2, 0, 1)
    fast, slow = np.arange(0, 16, 0.004), np.arange(0.0013, 15.9, 0.01)
    with jax.enable_x64(True):
        tau = np.asarray(jax.jit(jax.vmap(dynamics(true).inverse_dynamics))(*sums_of_sines(slow, *sines)))
    tau = tau + 0.02 * random.normal(size=tau.shape)
    q, qd, _ = sums_of_sines(fast, *sines)
    names = ["panda_elbow", "panda_shoulder", "panda_finger"]
    states = [state(t, names, [*q[k, ::-1], 0.02], [*qd[k, ::-1], 0.0]) for k, t in enumerate(fast)]
    currents = [state(t, names[1::-1], tau=tau[k] / KT) for k, t in enumerate(slow)]
    write_bag(folder / "motion", {"/joint_states": states, "/currents": currents}, mcap=True, others=["/rosout"])
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder


LOG = f"--data motion --robot arm.urdf --topics /joint_states,/currents --torque-factor {KT}"


@pytest.mark.slow
def test_three_commands_take_a_bag_to_c(place, capsys):
    command(check_data, LOG, "--out check")
    said = capsys.readouterr().out
    assert "joints matched by name: panda_shoulder=fer_shoulder, panda_elbow=fer_elbow" in said
    assert "joints left out: panda_finger" in said and "100 Hz; q and qd by cubic splines" in said
    assert "error: " not in said
    command(identify, LOG, "--cutoff auto --out run --no-figures --no-uncertainty")
    said = capsys.readouterr().out
    assert "\nverdict: good" in said and "joints matched by name" in said and f"times panda_shoulder {KT}" in said
    numbers = json_of(place / "run" / "metrics.json")
    assert numbers["nmse"] < 1e-3 < numbers["file_nmse"]
    command(export_c, "--run run --out c")
    at = np.array([0.3, 0.2]), np.array([0.5, -0.4]), np.array([1.0, 2.0])
    expected = load(place / "run").dynamics.inverse_dynamics(*at)
    np.testing.assert_allclose(load_c(place / "c").inverse_dynamics(*at), expected, rtol=1e-6)


def test_bags_that_do_not_suit_the_robot_are_one_line(place, capsys):
    rows = {
        "--topics /joint_states": "no efforts in the messages",
        "--joints panda_elbow,panda_finger": "the robot's joint 'fer_shoulder' is not among the data's",
        "--torque-factor fer_elbow=2": "'fer_elbow' is not among the log's joints (panda_shoulder, panda_elbow)",
        "--torque-factor panda_elbow=1,panda_elbow=2": "--torque-factor names 'panda_elbow' twice",
        "--torque-factor much": "--torque-factor is 'much'; expected finite numbers",
    }
    # The last of an option that is given twice counts.
    assert_refused(capsys, identify, rows.items(), LOG, out=place / "none")
