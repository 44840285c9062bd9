"""Robots that MuJoCo reads move as they do in MuJoCo, and as in Pinocchio where it is installed."""

import os
import textwrap

import jax
import numpy as np
import pytest

from dln_jax.data.robots import quiet, read_robot
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import pseudo_inertia, tree_system, world_frames
from dln_jax.types import InputError

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is the reference; it is in the extra [robot]")
LINK = """
<link name="{name}">
  <inertial>
    <origin xyz="0.1 -0.05 0.2" rpy="0.3 -0.2 0.5"/> <mass value="{mass}"/>
    <inertia ixx="0.03" iyy="0.04" izz="0.02" ixy="0.004" ixz="-0.002" iyz="0.001"/>
  </inertial>
  <visual><geometry><mesh filename="nowhere/{name}.stl"/></geometry></visual>
</link>"""
JOINT = """
<joint name="{name}" type="{kind}">
  <parent link="{parent}"/> <child link="{child}"/> <origin xyz="{xyz}" rpy="0.4 -0.3 0.2"/> <axis xyz="{axis}"/>
  <limit lower="-1" upper="2" effort="30" velocity="3"/> <dynamics damping="0.2" friction="0.1"/>
</joint>"""


def urdf(*parts):
    return f'<robot name="arm"><link name="base"/>{"".join(parts)}</robot>'


ARM = urdf(
    LINK.format(name="one", mass=2.0),
    LINK.format(name="two", mass=1.5),
    LINK.format(name="three", mass=0.7),
    LINK.format(name="hand", mass=0.4),
    JOINT.format(name="shoulder", kind="revolute", parent="base", child="one", xyz="0 0 0.3", axis="0 0 1"),
    JOINT.format(name="elbow", kind="continuous", parent="one", child="two", xyz="0.2 0 0.1", axis="0.6 0 0.8"),
    JOINT.format(name="slide", kind="prismatic", parent="two", child="three", xyz="0 0.3 0", axis="0 1 0"),
    JOINT.format(name="weld", kind="fixed", parent="three", child="hand", xyz="0.1 0 0.1", axis="1 0 0"),
)
BRANCHED = """
<mujoco><option gravity="1 -2 -9"/><worldbody>
  <body name="stand" pos="0.1 0 0.5" euler="10 20 30"><geom type="box" size=".1 .1 .1"/>
    <body name="a" pos="0 0.2 0.3" euler="40 0 10">
      <joint name="x" type="hinge" axis="1 0 0" pos="0 0.05 0.1" armature="0.3"/>
      <joint name="y" type="slide" axis="0 1 1"/>
      <geom type="capsule" size="0.05" fromto="0 0 0 0.1 0.2 0.4"/>
      <body name="b" pos="0 0 0.4"><joint name="z" damping="0.5"/><geom type="sphere" size=".1" pos=".2 0 0"/></body>
      <body name="c" pos="0.3 0 0" euler="0 90 0">
        <joint name="w" axis="0 1 0"/><geom type="sphere" size=".15" pos="0 .2 0"/>
        <body name="d" pos="0 0.1 0.2"><geom type="box" size=".05 .1 .02"/></body></body>
    </body>
  </body>
</worldbody></mujoco>"""
IN_NAMESPACE = ARM.replace("<robot", '<robot xmlns="https://drake.mit.edu"')
REFERENCED = BRANCHED.replace('name="x"', 'name="x" ref="25"').replace('name="y"', 'name="y" ref="-.3"')
FILES = {"arm.urdf": ARM, "in_namespace.urdf": IN_NAMESPACE, "branched.xml": BRANCHED, "referenced.xml": REFERENCED}


def written(folder, name, text):
    path = folder / name
    path.write_text(textwrap.dedent(text))
    return path


@pytest.mark.parametrize("name", FILES)
def test_forces_are_those_of_mujoco(name, tmp_path):
    path = written(tmp_path, name, FILES[name])
    robot = read_robot(path)
    text = FILES[name].replace("<visual>", "<!--").replace("</visual>", "-->")
    model = mujoco.MjModel.from_xml_string(text)
    model.dof_damping[:], model.dof_frictionloss[:] = 0, 0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    data = mujoco.MjData(model)
    motion = dynamics(tree_system(robot.tree), degrees_of_freedom=model.nv)

    @jax.jit
    def moved(q, qd, qdd):
        tau = motion.inverse_dynamics(q, qd, qdd)
        return tau, motion.forward_dynamics(q, qd, tau), world_frames(robot.tree, q)[1]

    random = np.random.default_rng(0)
    for _ in range(5):
        data.qpos, data.qvel, data.qacc = random.normal(size=(3, model.nv))
        wanted = np.array(data.qacc)
        mujoco.mj_inverse(model, data)
        tau, qdd, origins = map(np.asarray, moved(data.qpos, data.qvel, wanted))
        np.testing.assert_allclose(tau, data.qfrc_inverse, rtol=1e-10, atol=1e-10)
        data.qfrc_applied = tau
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(qdd, data.qacc, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(qdd, wanted, rtol=1e-9, atol=1e-9)
        turning = np.array(robot.tree.joints) == "revolute"  # MuJoCo's anchor of a slide stays behind
        np.testing.assert_allclose(origins[turning], data.xanchor[turning], atol=1e-12)


def test_forces_are_those_of_pinocchio(tmp_path):
    pinocchio = pytest.importorskip("pinocchio", reason="the reference is Pinocchio, of the extra [reference]")
    path = written(tmp_path, "arm.urdf", ARM.replace("continuous", "revolute"))
    robot, model = read_robot(path), pinocchio.buildModelFromUrdf(str(path))
    order = [model.joints[model.getJointId(name)].idx_q for name in robot.tree.names]
    state = np.random.default_rng(0).normal(size=(3, model.nv))
    tau = pinocchio.rnea(model, model.createData(), *state)[order]
    ours = jax.jit(dynamics(tree_system(robot.tree)).inverse_dynamics)(*state[:, order])
    np.testing.assert_allclose(ours, tau, rtol=1e-10, atol=1e-10)


def test_what_a_file_states_of_its_joints(tmp_path):
    robot = read_robot(written(tmp_path, "arm.urdf", ARM))
    assert robot.tree.names == ("shoulder", "elbow", "slide")
    assert robot.tree.joints == ("revolute", "revolute", "prismatic")
    np.testing.assert_array_equal(robot.damping, [0.2] * 3)
    np.testing.assert_array_equal(robot.coulomb, [0.1] * 3)
    np.testing.assert_array_equal(robot.position_limits, [[-1, 2], [-np.inf, np.inf], [-1, 2]])
    np.testing.assert_array_equal(robot.force_limits, [[-30, 30]] * 3)
    np.testing.assert_array_equal(robot.tree.gravity, [0, 0, -9.81])


ONE = LINK.format(name="one", mass=1.0)
SHOULDER = JOINT.format(name="shoulder", kind="revolute", parent="base", child="one", xyz="0 0 0", axis="0 0 1")
REFUSED = {
    "not XML": ("arm.urdf", "hello", "not XML"),
    "another element": ("arm.urdf", "<sdf/>", "its outer element is <sdf>"),
    "cyclic": (
        "arm.urdf",
        urdf(
            ONE, SHOULDER, JOINT.format(name="b", kind="revolute", parent="one", child="one", xyz="0 0 0", axis="0 0 1")
        ),
        "MuJoCo cannot compile it",
    ),
    "massless": (
        "arm.urdf",
        urdf('<link name="one"/>', SHOULDER),
        r"MuJoCo cannot compile it: .*mass|joint 'shoulder' moves no mass",
    ),
    "mimic": (
        "arm.urdf",
        urdf(ONE, SHOULDER.replace("<axis", '<mimic joint="other"/><axis')),
        r"joint 'shoulder' follows another \(mimic\)",
    ),
    "nothing moves": ("arm.urdf", urdf(ONE, SHOULDER.replace("revolute", "fixed")), "it has 0 joints"),
    "a ball": (
        "ball.xml",
        '<mujoco><worldbody><body><joint name="hip" type="ball"/><geom size="1"/></body></worldbody></mujoco>',
        "joint 'hip' is a ball; expected revolute and prismatic",
    ),
    "floating": (
        "free.xml",
        '<mujoco><worldbody><body><freejoint name="root"/><geom size="1"/></body></worldbody></mujoco>',
        "joint 'root' is free",
    ),
    "a spring": (
        "spring.xml",
        '<mujoco><default><joint stiffness="2"/></default><worldbody><body><joint name="hip"/><geom size="1"/></body>'
        "</worldbody></mujoco>",
        r"joint 'hip' has a spring \(stiffness 2\)",
    ),
    "entities": ("arm.urdf", '<!DOCTYPE x [<!ENTITY a "b">]><robot/>', "entities"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_tree_is_refused_in_one_line(case, tmp_path):
    name, text, message = REFUSED[case]
    with pytest.raises(InputError, match=message) as raised:
        read_robot(written(tmp_path, name, text))
    assert "\n" not in str(raised.value)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_robot(tmp_path / "arm.urdf")


def test_a_locked_joint_is_fixed(tmp_path):
    locked = read_robot(written(tmp_path, "arm.urdf", ARM), lock=["elb*"])
    fixed = ARM.replace('"elbow" type="continuous"', '"elbow" type="fixed"')
    robot = read_robot(written(tmp_path, "fixed.urdf", fixed))
    assert locked.tree.names == robot.tree.names == ("shoulder", "slide")
    assert (locked.tree.parents, locked.tree.joints) == (robot.tree.parents, robot.tree.joints)
    np.testing.assert_array_equal(locked.position_limits, robot.position_limits)
    for key in ("rotations", "positions", "axes", "inertias", "armature"):
        np.testing.assert_allclose(getattr(locked.tree, key), getattr(robot.tree, key), rtol=1e-12, atol=1e-14)


FREE = (
    '<freejoint name="root"/><geom size="1"/><body><joint name="a" axis="0 1 0"/><geom size=".1" pos=".3 0 0"/></body>'
)


def test_a_free_base_can_be_locked(tmp_path):
    path = written(tmp_path, "free.xml", f"<mujoco><worldbody><body>{FREE}</body></worldbody></mujoco>")
    assert read_robot(path, lock=["root"]).tree.names == ("a",)


LOCKED = {
    "turned": ("branched.xml", {"x": 0.7, "w": -0.4}),
    "referenced": ("referenced.xml", {"x": 0.7, "y": 0.2}),
    "moved": ("arm.urdf", {"slide": 0.2}),
}


@pytest.mark.parametrize("name", LOCKED)
def test_joints_are_locked_at_their_positions(name, tmp_path):
    file, lock = LOCKED[name]
    path = written(tmp_path, file, FILES[file])
    free, locked = read_robot(path), read_robot(path, lock=lock)
    place = np.array([free.tree.names.index(name) for name in locked.tree.names])
    q, qd, qdd = np.zeros((3, free.tree.degrees_of_freedom))
    for joint, position in lock.items():
        q[free.tree.names.index(joint)] = position
    q[place], qd[place], qdd[place] = np.random.default_rng(0).normal(size=(3, len(place)))
    every = jax.jit(dynamics(tree_system(free.tree)).inverse_dynamics)(q, qd, qdd)
    fewer = jax.jit(dynamics(tree_system(locked.tree)).inverse_dynamics)(q[place], qd[place], qdd[place])
    np.testing.assert_allclose(fewer, every[place], rtol=1e-12, atol=1e-12)


def test_a_gripper_whose_fingers_are_tied_can_be_locked(tmp_path):
    tied = ARM.replace('<parent link="two"/>', '<mimic joint="elbow"/><parent link="two"/>')
    path = written(tmp_path, "arm.urdf", tied)
    with pytest.raises(InputError, match="joint 'slide' follows another"):
        read_robot(path)
    assert read_robot(path, lock=["slide"]).tree.names == ("shoulder", "elbow")
    with pytest.raises(InputError, match=r"there is no joint 'finger\*' to lock; the joints are shoulder, elbow"):
        read_robot(path, lock=["finger*"])


def test_inertias_that_no_body_has_are_read_as_they_are(tmp_path):
    """As published files have them; MuJoCo alone would refuse."""
    flat = ARM.replace('izz="0.02"', 'izz="-0.5"')
    tree = read_robot(written(tmp_path, "flat.urdf", flat)).tree
    true = read_robot(written(tmp_path, "arm.urdf", ARM)).tree
    assert np.linalg.eigvalsh(pseudo_inertia(tree.inertias[0]))[0] < 0
    np.testing.assert_allclose(tree.inertias[:, :4], true.inertias[:, :4], rtol=1e-12)


ATTRIBUTES = "<mujoco><worldbody " + " ".join(f'a{k}=""' for k in range(1000)) + "/></mujoco>"


def nested(depth):
    return "<mujoco><worldbody>" + "<body><joint/>" * depth + "</body>" * depth + "</worldbody></mujoco>"


def links(count, kind="revolute"):
    parts = [LINK.format(name=f"l{k}", mass=1.0) for k in range(count)]
    joints = [
        JOINT.format(
            name=f"j{k}", kind=kind, parent=f"l{k - 1}" if k else "base", child=f"l{k}", xyz="0 0 1", axis="0 0 1"
        )
        for k in range(count)
    ]
    return urdf(*parts, *joints)


BOMB = '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><robot name="&b;"/>'
HEADED = '<?xml version="1.0" encoding="{}"?>'
MALFORMED = {
    "unknown encoding": (HEADED.format("teapot") + ARM, "teapot"),
    "encoding of more bytes": (HEADED.format("utf-7") + ARM, "encodings"),
    "entities": (BOMB, "entities"),
    "entities in UTF-16": ((HEADED.format("utf-16") + BOMB).encode("utf-16"), "entities"),
    "not XML": (b"\x00\xff" * 50, "not XML"),
    "nested": (nested(100_000), "nested"),
    "many attributes": (ATTRIBUTES, "attributes"),
    "many joints": (links(3000), "elements|joints"),
    "300 joints": (links(300), "300 joints"),
    "many bodies": ('<mujoco><worldbody><replicate count="100000000"/></worldbody></mujoco>', "repeats"),
    "memory": (BRANCHED.replace("<worldbody>", '<size memory="100000G"/><worldbody>'), "MuJoCo cannot"),
    "planar joint": (ARM.replace('type="continuous"', 'type="planar"'), "of type 'planar'"),
    "joint without a type": (ARM.replace('type="continuous"', ""), "of type 'None'"),
    "two joints of one name": (ARM.replace('joint name="elbow"', 'joint name="shoulder"'), "two joints are named"),
    "damping in words": (ARM.replace('damping="0.2"', 'damping="much"', 1), "damping in <dynamics> is 'much'"),
    "damping that is NaN": (ARM.replace('damping="0.2"', 'damping="nan"', 1), "damping in <dynamics> is 'nan'"),
    "damping that drives": (ARM.replace('damping="0.2"', 'damping="-1"', 1), "zero or more"),
    "mass beyond all": (ARM.replace('mass value="2.0"', 'mass value="1e308"'), "inertia of joint"),
    "velocity in words": (
        ARM.replace('velocity="3"', 'velocity="fast"', 1),
        "limit of velocity of 'fast'; expected a number",
    ),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_a_malformed_file_is_refused_in_one_line(case, tmp_path, monkeypatch):
    """And MuJoCo leaves no log of its own in the working folder."""
    monkeypatch.chdir(tmp_path)
    content, message = MALFORMED[case]
    path = tmp_path / "robot.xml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=message) as caught:
        read_robot(path)
    assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["robot.xml"]


@pytest.mark.parametrize("name", ["include", "mesh"])
def test_a_pipe_in_a_model_is_refused_and_not_waited_for(name, tmp_path):
    (tmp_path / "parts").mkdir()
    os.mkfifo(tmp_path / "parts" / "pipe.obj")
    asset = '<compiler meshdir="parts"/><asset><mesh name="m" file="pipe.obj"/></asset>'
    part = '<include file="parts/pipe.obj"/>' if name == "include" else asset
    (tmp_path / "part.xml").write_text(f"<mujoco>{part}</mujoco>")
    (tmp_path / "arm.xml").write_text('<mujoco><include file="part.xml"/></mujoco>')
    with pytest.raises(InputError, match="is no regular file"):
        read_robot(tmp_path / "arm.xml")


def test_a_diverging_simulation_leaves_no_log(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = mujoco.MjModel.from_xml_string(BRANCHED)
    data = mujoco.MjData(model)
    with quiet(mujoco):
        data.qvel[:] = 1e12
        mujoco.mj_step(model, data, 3)
    assert not list(tmp_path.iterdir()) and mujoco.get_mju_user_warning() is None
