"""Robots that MuJoCo reads move as they do in MuJoCo; what is no tree of joints is refused."""

import os
import textwrap

import jax
import mujoco
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax import dynamics, read_robot, tree_system
from dln_jax.mechanics.trees.frames import world_frames
from dln_jax.mechanics.trees.inertia import pseudo_inertia

LINK = """
<link name="{0}">
  <inertial>
    <origin xyz="0.1 -0.05 0.2" rpy="0.3 -0.2 0.5"/> <mass value="{1}"/>
    <inertia ixx="0.03" iyy="0.04" izz="0.02" ixy="0.004" ixz="-0.002" iyz="0.001"/>
  </inertial>
  <visual><geometry><mesh filename="nowhere/{0}.stl"/></geometry></visual>
</link>"""
JOINT = """
<joint name="{}" type="{}">
  <parent link="{}"/> <child link="{}"/> <origin xyz="{}" rpy="0.4 -0.3 0.2"/> <axis xyz="{}"/>
  <limit lower="-1" upper="2" effort="30" velocity="3"/> <dynamics damping="0.2" friction="0.1"/>
</joint>"""


def urdf(*parts):
    return f'<robot name="arm"><link name="base"/>{"".join(parts)}</robot>'


def joint(name, kind, parent, child, xyz="0 0 1", axis="0 0 1"):
    return JOINT.format(name, kind, parent, child, xyz, axis)


SHOULDER = joint("shoulder", "revolute", "base", "one", xyz="0 0 0.3")
ARM = urdf(
    *(LINK.format(*link) for link in (("one", 2.0), ("two", 1.5), ("three", 0.7), ("hand", 0.4))),
    SHOULDER,
    joint("elbow", "continuous", "one", "two", xyz="0.2 0 0.1", axis="0.6 0 0.8"),
    joint("slide", "prismatic", "two", "three", xyz="0 0.3 0", axis="0 1 0"),
    joint("weld", "fixed", "three", "hand", xyz="0.1 0 0.1", axis="1 0 0"),
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
        <joint name="w" axis="0 1 0" pos="0.1 0 0"/><geom type="sphere" size=".15" pos="0 .2 0"/>
        <body name="d" pos="0 0.1 0.2"><geom type="box" size=".05 .1 .02"/></body></body>
    </body>
  </body>
</worldbody></mujoco>"""
REFERENCED = BRANCHED.replace('name="x"', 'name="x" ref="25"').replace('name="y"', 'name="y" ref="-.3"')
FILES = {"arm.urdf": ARM, "branched.xml": BRANCHED, "referenced.xml": REFERENCED}


def written(folder, name, text):
    path = folder / name
    path.write_text(textwrap.dedent(text))
    return path


@pytest.mark.parametrize("name", ["arm.urdf", "referenced.xml"])
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
        assert_allclose(tau, data.qfrc_inverse, rtol=1e-10, atol=1e-10)
        data.qfrc_applied = tau
        mujoco.mj_forward(model, data)
        assert_allclose(qdd, data.qacc, rtol=1e-8, atol=1e-8)
        assert_allclose(qdd, wanted, rtol=1e-9, atol=1e-9)
        turning = np.array(robot.tree.joints) == "revolute"  # MuJoCo's anchor of a slide stays behind
        assert_allclose(origins[turning], data.xanchor[turning], atol=1e-12)


def test_what_a_file_states_of_its_joints(tmp_path):
    in_namespace = ARM.replace("<robot", '<robot xmlns="https://drake.mit.edu"')
    robot = read_robot(written(tmp_path, "arm.urdf", in_namespace))
    assert robot.tree.names == ("shoulder", "elbow", "slide")
    assert robot.tree.joints == ("revolute", "revolute", "prismatic")
    assert_array_equal(robot.damping, [0.2] * 3)
    assert_array_equal(robot.coulomb, [0.1] * 3)
    assert_array_equal(robot.position_limits, [[-1, 2], [-np.inf, np.inf], [-1, 2]])
    assert_array_equal(robot.force_limits, [[-30, 30]] * 3)
    assert_array_equal(robot.tree.gravity, [0, 0, -9.81])


def test_joints_are_locked_at_their_positions(tmp_path):
    for file, lock in (
        ("branched.xml", {"z": 0.7, "w": -0.4}),
        ("referenced.xml", {"x": 0.7, "y": 0.2}),
        ("arm.urdf", {"slide": 0.2}),
    ):
        path = written(tmp_path, file, FILES[file])
        free, locked = read_robot(path), read_robot(path, lock=lock)
        place = np.array([free.tree.names.index(name) for name in locked.tree.names])
        state = np.zeros((3, free.tree.degrees_of_freedom))
        state[0] = [lock.get(name, 0.0) for name in free.tree.names]
        state[:, place] = np.random.default_rng(0).normal(size=(3, len(place)))
        every, fewer = (
            jax.jit(dynamics(tree_system(robot.tree)).inverse_dynamics)(*states)
            for robot, states in ((free, state), (locked, state[:, place]))
        )
        assert_allclose(fewer, every[place], rtol=1e-12, atol=1e-12)


def test_a_gripper_whose_fingers_are_tied_and_a_free_base_can_be_locked(tmp_path):
    tied = ARM.replace('<parent link="two"/>', '<mimic joint="elbow"/><parent link="two"/>')
    path = written(tmp_path, "arm.urdf", tied)
    with one_line(r"joint 'slide' follows another joint \(mimic\)"):
        read_robot(path)
    assert read_robot(path, lock=["sl*"]).tree.names == ("shoulder", "elbow")
    with one_line(r"there is no joint 'finger\*' to lock; the joints are shoulder, elbow"):
        read_robot(path, lock=["finger*"])
    base = '<body><freejoint name="root"/><geom size="1"/><body name="arm">'
    text = HINGE.format("").replace('<body name="arm">', base).replace("</body>", "</body></body>")
    assert read_robot(written(tmp_path, "free.xml", text), lock=["root"]).tree.names == ("elbow",)


def test_inertias_that_no_body_has_are_read_as_they_are(tmp_path):
    """As published files have them; MuJoCo alone would refuse."""
    flat = ARM.replace('izz="0.02"', 'izz="-0.5"')
    tree = read_robot(written(tmp_path, "flat.urdf", flat)).tree
    true = read_robot(written(tmp_path, "arm.urdf", ARM)).tree
    assert np.linalg.eigvalsh(pseudo_inertia(tree.inertias[0]))[0] < 0
    assert_allclose(tree.inertias[:, :4], true.inertias[:, :4], rtol=1e-12)


ONE = LINK.format("one", 1.0)
HINGE = """<mujoco><worldbody><body name="arm"><inertial mass="1" pos="0.1 0 0" diaginertia="1 1 1"/>
<joint name="elbow" axis="0 1 0" {}/></body></worldbody></mujoco>"""
BOMB = '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><robot name="&b;"/>'
HEADED = '<?xml version="1.0" encoding="{}"?>'
RANGE = "joint 'shoulder' has limits of position .*; expected two finite numbers"


def nested(depth):
    return "<mujoco><worldbody>" + "<body><joint/>" * depth + "</body>" * depth + "</worldbody></mujoco>"


def chain(count):
    parts = [LINK.format(f"l{k}", 1.0) for k in range(count)]
    return urdf(*parts, *(joint(f"j{k}", "revolute", f"l{k - 1}" if k else "base", f"l{k}") for k in range(count)))


def limited(old, new):
    """The arm with other numbers at its first joint."""
    return ARM.replace(old, new, 1)


REFUSED = (
    (b"\x00\xff" * 50, "not XML"),
    ("<sdf/>", "its outer element is <sdf>"),
    (HEADED.format("teapot") + ARM, "teapot"),
    (BOMB, "entities"),
    ((HEADED.format("utf-16") + BOMB).encode("utf-16"), "entities"),
    (nested(100_000), "nested"),
    ("<mujoco><worldbody " + " ".join(f'a{k}=""' for k in range(1000)) + "/></mujoco>", "attributes"),
    (chain(3000), "elements"),
    (chain(300), "300 joints"),
    ('<mujoco><worldbody><replicate count="100000000"/></worldbody></mujoco>', "repeats"),
    (BRANCHED.replace("<worldbody>", '<size memory="100000G"/><worldbody>'), "MuJoCo cannot"),
    (urdf(ONE, SHOULDER, joint("b", "revolute", "one", "one")), "MuJoCo cannot compile it"),  # cyclic
    (urdf('<link name="one"/>', SHOULDER), "MuJoCo cannot compile it: .*mass|joint 'shoulder' moves no mass"),
    (ARM.replace('mass value="2.0"', 'mass value="1e308"'), "inertia of joint"),
    (urdf(ONE, SHOULDER.replace("revolute", "fixed")), "it has 0 joints"),
    (ARM.replace('type="continuous"', 'type="planar"'), "of type 'planar'"),
    (ARM.replace('type="continuous"', ""), "of type 'None'"),
    (ARM.replace('joint name="elbow"', 'joint name="shoulder"'), "names 'shoulder' twice; expected once"),
    (
        HINGE.replace('name="elbow" axis="0 1 0" {}', 'name="hip" type="ball"'),
        "joint 'hip' is a ball",
    ),
    (HINGE.replace('<joint name="elbow" axis="0 1 0" {}', '<freejoint name="root"'), "joint 'root' is free"),
    (HINGE.format('stiffness="2"'), r"joint 'elbow' has a spring \(stiffness 2\)"),
    (limited('damping="0.2"', 'damping="nan"'), "damping in <dynamics> is 'nan'"),
    (limited('damping="0.2"', 'damping="-1"'), "zero or more"),
    (limited('velocity="3"', 'velocity="fast"'), "velocity in <limit> is 'fast'; expected zero or more"),
    (limited('effort="30"', 'effort="nan"'), "effort in <limit> is 'nan'"),
    # MuJoCo would read each of these as a joint without limits.
    (limited('lower="-1"', ""), RANGE),
    *((limited('lower="-1"', f'lower="{lower}"'), RANGE) for lower in ("nan", "-inf", "ten", "2", "3")),
    *((HINGE.format(f'range="{each}"'), "'elbow' has limits of position") for each in ("nan 2", "1 -1", "0 0")),
    *((HINGE.format(f'actuatorfrcrange="{each}"'), "'elbow' has limits of torque") for each in ("2 -2", "0 0")),
    (HINGE.replace("<mujoco>", '<mujoco><default><joint range="1 -1"/></default>').format(""), "position 1, -1"),
)


def test_what_is_no_tree_is_refused_in_one_line(tmp_path, monkeypatch):
    """And MuJoCo leaves no log of its own in the working folder."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "robot.xml"
    with one_line("no such file"):
        read_robot(path)
    for content, message in REFUSED:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        with one_line(message):
            read_robot(path)
    assert [each.name for each in tmp_path.iterdir()] == ["robot.xml"]


def test_limits_are_checked_in_files_of_files(tmp_path):
    for stated in ("1 -1", "0 0"):
        (tmp_path / "part.xml").write_text(HINGE.format(f'range="{stated}"'))
        (tmp_path / "nested.xml").write_text('<mujoco><include file="part.xml"/></mujoco>')
        attached = (
            '<asset><model name="m" file="part.xml"/></asset><worldbody><body><attach model="m" body="arm" prefix="'
        )
        for text in ('<include file="nested.xml"/>', attached + 'the_"/></body></worldbody>'):
            with one_line(f"elbow' has limits of position {stated.split()[0]}"):
                read_robot(written(tmp_path, "arm.xml", f"<mujoco>{text}</mujoco>"))


def test_limits_that_are_switched_off_or_zero_are_not_stated(tmp_path):
    default = '<mujoco><default><default class="other"><joint range="1 -1"/></default><joint {}/></default>'
    for text in (
        HINGE.format('range="0 0" limited="false"'),
        HINGE.format("").replace("<mujoco>", default.format("")),
        HINGE.format('range="-1 1"').replace("<mujoco>", default.format('limited="false"')),
    ):
        assert np.isinf(read_robot(written(tmp_path, "arm.xml", text)).position_limits).all()
    zeros = limited('effort="30" velocity="3"', 'effort="0" velocity="0"')
    robot = read_robot(written(tmp_path, "arm.urdf", zeros))
    assert np.isinf(robot.velocity_limits[0]) and np.isinf(robot.force_limits[0]).all()
    assert_array_equal(robot.position_limits[0], [-1, 2])
    swapped = read_robot(written(tmp_path, "arm.urdf", limited('lower="-1"', 'lower="3"')), lock=["shoulder"])
    assert swapped.tree.names == ("elbow", "slide")


@pytest.mark.parametrize("name", ["include", "mesh"])
def test_a_pipe_in_a_model_is_refused_and_not_waited_for(name, tmp_path):
    (tmp_path / "parts").mkdir()
    os.mkfifo(tmp_path / "parts/pipe.obj")
    asset = '<compiler meshdir="parts"/><asset><mesh name="m" file="pipe.obj"/></asset>'
    part = '<include file="parts/pipe.obj"/>' if name == "include" else asset
    (tmp_path / "part.xml").write_text(f"<mujoco>{part}</mujoco>")
    (tmp_path / "arm.xml").write_text('<mujoco><include file="part.xml"/></mujoco>')
    with one_line("is not a regular file"):
        read_robot(tmp_path / "arm.xml")
