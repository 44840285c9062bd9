"""A robot that is written and read again is the same, whatever was fixed to its links."""

import xml.etree.ElementTree as ET

import jax
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax import dynamics, read_robot, tree_system
from dln_jax.data.robot_files import mjcf, write_robot

INERTIAL = """<inertial><origin xyz="0.1 -0.05 0.2" rpy="0.3 -0.2 0.5"/><mass value="{mass}"/>
<inertia ixx="0.03" iyy="0.04" izz="0.02" ixy="0.004" ixz="-0.002" iyz="0.001"/></inertial>"""
URDF = f"""<robot name="arm"><!-- kept --><link name="base">{INERTIAL.format(mass=9)}</link>
<link name="one">{INERTIAL.format(mass=2)}</link><link name="two"/>
<link name="hand"><visual><geometry><mesh filename="nowhere.stl"/></geometry></visual>{INERTIAL.format(mass=0.5)}</link>
<link name="finger">{INERTIAL.format(mass=0.25)}</link>
<joint name="elbow" type="continuous"><parent link="one"/><child link="two"/><origin xyz="0.2 0 0.1"/>
 <axis xyz="0.6 0 0.8"/></joint>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="one"/><origin xyz="0 0 0.3" rpy="0.4 0 0"/>
 <axis xyz="0 0 1"/><limit lower="-1" upper="2" effort="30" velocity="3"/>
 <dynamics damping="0.2" friction="0.1"/></joint>
<joint name="weld" type="fixed"><parent link="two"/><child link="hand"/><origin xyz="0.1 0 0.1" rpy="0 1 0"/></joint>
<joint name="tip" type="fixed"><parent link="hand"/><child link="finger"/></joint></robot>"""
MJCF = """<mujoco><compiler angle="radian" inertiafromgeom="true"/><default><joint damping="3"/></default><worldbody>
  <body name="stand" euler="0.1 0.2 0.3"><geom type="box" size=".1 .1 .1"/>
    <body name="a" pos="0 0.2 0.3" euler="0.4 0 0.1">
      <joint name="x" type="hinge" axis="1 0 0" pos="0 0.05 0.1" armature="0.3"/>
      <joint name="y" type="slide" axis="0 1 1"/><geom type="capsule" size="0.05" fromto="0 0 0 0.1 0.2 0.4"/>
      <frame pos="0.1 0 0">
        <body name="b" pos="0 0 0.4"><joint/><geom type="sphere" size=".1" pos=".2 0 0"/></body></frame>
      <body name="c" pos="0.3 0 0" euler="0 1 0"><geom type="sphere" size=".15" pos="0 .2 0"/>
        <body name="d" pos="0 0.1 0.2"><geom type="box" size=".05 .1 .02"/></body></body>
    </body></body></worldbody></mujoco>"""
FILES = {"arm.urdf": URDF, "arm.xml": MJCF}


@pytest.fixture(params=FILES)
def original(request, tmp_path):
    path = tmp_path / request.param
    path.write_text(FILES[request.param])
    return path


def test_what_is_written_is_read_again_and_mistakes_are_one_line(original):
    robot = read_robot(original)
    d, random = robot.tree.degrees_of_freedom, np.random.default_rng(0)
    heavier = robot.tree.inertias * random.uniform(1, 2, d)[:, None]
    armature = random.uniform(0.1, 0.2, d) * (original.suffix == ".xml")
    tree = robot.tree._replace(inertias=heavier, armature=armature)
    damping, coulomb = random.uniform(0.1, 1, (2, d))
    path = original.with_name(f"new{original.suffix}")
    write_robot(path, original, tree, damping=damping, coulomb=coulomb, remarks=("Identified -- once.",))
    again = read_robot(path)
    assert again.tree.parents == tree.parents and again.tree.names == tree.names
    for name in ("rotations", "positions", "axes", "inertias", "armature"):
        assert_allclose(getattr(again.tree, name), getattr(tree, name), rtol=1e-12, atol=1e-14)
    for ours, expected in zip(again[1:4], (damping, coulomb, robot.position_limits), strict=True):
        assert_array_equal(ours, expected)
    assert original.read_text() == FILES[original.name] and "Identified - - once." in path.read_text()
    hollow = np.where(np.arange(10) == 4, -1.0, heavier)
    if original.suffix == ".xml":
        including = original.with_name("including.xml")
        including.write_text(MJCF.replace("<default>", '<include file="more.xml"/><default>'))
        original.with_name("more.xml").write_text("<mujoco><option/></mujoco>")
    for change, source, target, message in (
        ({}, original, original, "is the original file"),
        ({"names": tuple("abc"[:d])}, original, path, "the tree has a, b"),
        ({"inertias": hollow}, original, path, "is not physically consistent"),
        *([({}, including, path, "<include>")] if original.suffix == ".xml" else []),
    ):
        with one_line(message):
            write_robot(target, source, tree._replace(**change))


def test_a_file_keeps_what_is_not_identified(tmp_path):
    original, path = tmp_path / "arm.urdf", tmp_path / "new.urdf"
    original.write_text(URDF)
    tree = read_robot(original).tree
    write_robot(path, original, tree._replace(armature=np.array([0.5, 0.25])))
    for words in ("kept", "nowhere.stl", "URDF cannot state (kg m² or kg): shoulder 0.5, elbow 0.25"):
        assert words in path.read_text()
    masses = {link.get("name"): link.find("inertial/mass") for link in ET.parse(path).getroot().findall("link")}
    assert masses["base"].get("value") == "9" and masses["hand"] is masses["finger"] is None
    assert_allclose(float(masses["two"].get("value")), 0.75)


def test_coupled_motors_of_joints_without_names_are_read_again(tmp_path):
    original, path = tmp_path / "arm.xml", tmp_path / "new.xml"
    original.write_text(MJCF)
    tree = read_robot(original).tree
    armature = np.eye(len(tree.joints)) + 0.1
    write_robot(path, original, tree._replace(armature=armature))
    again = read_robot(path).tree
    assert again.names == tree.names
    assert_allclose(again.armature, armature)


def test_a_robot_survives_as_mjcf(tmp_path):
    original, path = tmp_path / "arm.urdf", tmp_path / "arm.xml"
    original.write_text(URDF)
    robot = read_robot(original)
    changes = {"joints": ("revolute", "prismatic"), "armature": np.array([0.1, 0.2]), "gravity": np.array([1, -2, -9])}
    robot = robot._replace(tree=robot.tree._replace(**changes))
    path.write_text(mjcf(robot))
    again = read_robot(path)
    assert (again.tree.names, again.tree.parents, again.tree.joints) == (robot.tree.names, *robot.tree[:2])
    for numbers, expected in zip(again[1:5], robot[1:5], strict=True):
        assert_array_equal(numbers, expected)
    state = np.random.default_rng(0).normal(size=(3, len(robot.damping)))
    forces = (jax.jit(dynamics(tree_system(each.tree)).inverse_dynamics)(*state) for each in (again, robot))
    assert_allclose(*forces, rtol=1e-12, atol=1e-12)
    massless = robot.tree._replace(inertias=0 * robot.tree.inertias)
    with one_line(f"the link of joint '{robot.tree.names[0]}' has a mass of 0 kg"):
        mjcf(robot._replace(tree=massless))
    with one_line("time_step is 0.0; expected a positive number"):
        mjcf(robot, time_step=0.0)
