"""Limits of a robot's file that are none are refused: MuJoCo would read each as a joint without limits."""

import itertools

import numpy as np
import pytest

from dln_jax.data.robots import read_robot
from dln_jax.types import InputError

pytest.importorskip("mujoco", reason="MuJoCo reads the robot files; it is in the extra [robot]")
URDF = """<robot name="arm"><link name="base"/><link name="arm"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="elbow" type="{}"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/><limit {}/></joint></robot>"""
MJCF = """<mujoco><worldbody><body><inertial mass="1" pos="0.1 0 0" diaginertia="1 1 1"/>
<joint name="elbow" axis="0 1 0" {}/></body></worldbody></mujoco>"""
POSITIONS = ["nan 2", "-2 nan", "1 1", "0 0", "2 -2", "-inf inf", "-inf 2"]


def read(folder, text, **settings):
    path = folder / ("arm.urdf" if text.startswith("<robot") else "arm.xml")
    path.write_text(text)
    return read_robot(path, **settings)


@pytest.mark.parametrize("stated", [*POSITIONS, "-2", "ten 2"])
def test_urdf_position(tmp_path, stated):
    sides = dict(zip(("lower", "upper"), stated.split(), strict=False))
    limit = " ".join(f'{side}="{value}"' for side, value in sides.items()) + ' effort="5" velocity="2"'
    for kind in ("revolute", "prismatic"):
        with pytest.raises(InputError, match=r"joint 'elbow' has limits of position .*; expected two finite numbers"):
            read(tmp_path, URDF.format(kind, limit))


@pytest.mark.parametrize("stated", ["nan", "-2", "fast"])
def test_urdf_velocity_and_effort(tmp_path, stated):
    for kind, quantity in itertools.product(("revolute", "prismatic", "continuous"), ("velocity", "effort")):
        with pytest.raises(InputError, match=f"joint 'elbow' has a limit of {quantity} of '{stated}'"):
            read(tmp_path, URDF.format(kind, f'lower="-2" upper="2" {quantity}="{stated}"'))


def test_urdf_zero_velocity_and_effort_are_not_stated(tmp_path):
    robot = read(tmp_path, URDF.format("revolute", 'lower="-2" upper="1" velocity="0" effort="0"'))
    np.testing.assert_array_equal(robot.position_limits, [[-2, 1]])
    assert np.isinf(robot.velocity_limits).all() and np.isinf(robot.force_limits).all()


@pytest.mark.parametrize("stated", POSITIONS)
def test_mjcf(tmp_path, stated):
    for attribute, kind in (("range", "position"), ("actuatorfrcrange", "torque")):
        with pytest.raises(InputError, match=f"joint 'elbow' has limits of {kind} {stated.split()[0]}"):
            read(tmp_path, MJCF.format(f'{attribute}="{stated}"'))


def test_mjcf_default_class_and_included_file(tmp_path):
    default = '<mujoco><default><joint range="1 -1"/></default>'
    with pytest.raises(InputError, match="joint 'elbow' has limits of position 1, -1"):
        read(tmp_path, MJCF.format("").replace("<mujoco>", default))
    (tmp_path / "part.xml").write_text(MJCF.format('range="1 -1"'))
    with pytest.raises(InputError, match="joint 'elbow' has limits of position 1, -1"):
        read(tmp_path, '<mujoco><include file="part.xml"/></mujoco>')


@pytest.mark.parametrize("stated", ["nan 1", "1 -1", "0 0"])
def test_mjcf_in_files_of_files(tmp_path, stated):
    (tmp_path / "part.xml").write_text(MJCF.format(f'range="{stated}"').replace("<body>", '<body name="arm">'))
    (tmp_path / "nested.xml").write_text('<mujoco><include file="part.xml"/></mujoco>')
    attached = '<asset><model name="m" file="part.xml"/></asset><worldbody><body><attach model="m" body="arm" prefix="'
    for text in ('<include file="nested.xml"/>', attached + 'the_"/></body></worldbody>'):
        with pytest.raises(InputError, match=f"elbow' has limits of position {stated.split()[0]}"):
            read(tmp_path, f"<mujoco>{text}</mujoco>")


def test_mjcf_default_class_without_joints_and_switched_off_by_it(tmp_path):
    default = '<mujoco><default><default class="other"><joint range="1 -1"/></default><joint {}/></default>'
    unlimited = read(tmp_path, MJCF.format("").replace("<mujoco>", default.format("")))
    assert np.isinf(unlimited.position_limits).all()
    off = default.format('limited="false"')
    free = read(tmp_path, MJCF.format('range="-1 1"').replace("<mujoco>", off))
    assert np.isinf(free.position_limits).all()


def test_switched_off_range_and_held_joint_are_accepted(tmp_path):
    free = read(tmp_path, MJCF.format('range="0 0" limited="false"'))
    assert np.isinf(free.position_limits).all()
    swapped = URDF.format("revolute", 'lower="2" upper="-2"')
    other = swapped.replace("elbow", "wrist").replace('"arm"', '"hand"').replace('"base"', '"arm"')
    two = swapped.replace('upper="-2"', 'upper="3"').replace("</robot>", other.partition('<link name="arm"/>')[2])
    assert read(tmp_path, two, lock=["wrist"]).tree.names == ("elbow",)
    with pytest.raises(InputError, match="joint 'wrist' has limits of position 2, -2"):
        read(tmp_path, two)
