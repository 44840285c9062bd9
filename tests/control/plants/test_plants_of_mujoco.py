"""Plants are read from files: layout, goal and limits, and mistakes in one line."""

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.plants import guarded, mujoco_plant
from dln_jax.control.state_space import field_of, integrated
from dln_jax.data.robots import read_robot
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import tree_system
from dln_jax.types import InputError

pytest.importorskip("mujoco", reason="MuJoCo simulates the plants; it is in the extra [robot]")
ROD = '<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".01" mass=".2" contype="0" conaffinity="0"/>'
CART_POLE = f"""<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0" range="-.5 .5" limited="true"/>
<geom type="box" size=".05 .05 .05" mass="1"/><body><joint name="hinge" axis="0 1 0"/>{ROD}</body></body></worldbody>
<actuator><motor joint="rail" gear="2" ctrllimited="true" ctrlrange="-5 5"/></actuator></mujoco>"""
STANDING = CART_POLE.replace('name="hinge"', 'name="hinge" range="-90 90"').replace("0 0 -.3", "0 0 .3")
"""A pole that stands at zero and cannot fall farther than to the level of its cart, as Gymnasium's."""
SLIDE = 'type="slide" axis="1 0 0" range="-.5 .5" limited="true"'
TWO_LINKS = f"""<mujoco><worldbody><body><joint name="shoulder" axis="0 1 0"/>{ROD}<body pos="0 0 -.3">
<joint name="elbow" axis="0 1 0"/>{ROD}</body></body></worldbody></mujoco>"""


def test_the_layout_of_a_cart_pole_is_that_of_its_file():
    layout = mujoco_plant(CART_POLE).layout
    assert layout.joints == ("prismatic", "revolute") and layout.names == ("rail", "hinge") and layout.rate == 500.0
    np.testing.assert_array_equal(layout.actuation, [[1.0], [0.0]])
    np.testing.assert_array_equal(layout.limits.control, [[-10.0, 10.0]])
    np.testing.assert_array_equal(layout.limits.position, [[-0.5, 0.5], [-np.inf, np.inf]])
    np.testing.assert_allclose(layout.hanging, 0, atol=1e-6)
    np.testing.assert_allclose(np.abs(layout.goal), [0, np.pi], atol=1e-6)


def test_the_goal_is_the_highest_posture_also_of_a_tilted_plant():
    tilted = TWO_LINKS.replace("<worldbody><body>", '<worldbody><body euler="0 10 0">')
    layout = mujoco_plant(tilted, ["elbow"], control=5.0).layout
    upright = np.remainder(layout.goal + np.deg2rad([10.0, 0.0]), 2 * np.pi)
    np.testing.assert_allclose(upright, [np.pi, 0], atol=1e-5)
    np.testing.assert_allclose(layout.hanging, np.deg2rad([-10.0, 0.0]), atol=1e-5)


def test_the_energy_of_an_idle_plant_is_kept_and_controls_act_late():
    file = TWO_LINKS.replace("<mujoco>", '<mujoco><option integrator="RK4"/>')
    plant = guarded(mujoco_plant(file, [1], control=1.0, hardware=Hardware(delay=2), seed=3))
    plant.reset()
    first = plant.read()
    for _ in range(50):
        plant.act([0.0])
        plant.read()
    assert np.abs(plant.read() - first).max() > 1e-3 and plant.time() == pytest.approx(0.1)

    def after(u):
        plant = guarded(mujoco_plant(file, [1], control=1.0, hardware=Hardware(delay=2), seed=3))
        plant.reset()
        return [plant.act([value]) or plant.read() for value in u]

    pushed, idle = after([1.0, 0.0, 0.0]), after([0.0, 0.0, 0.0])
    np.testing.assert_array_equal(pushed[:2], idle[:2])
    assert pushed[2][1] > idle[2][1]


@pytest.mark.parametrize(
    ("file", "actuated", "control", "message"),
    [
        (TWO_LINKS, ["wrist"], 1.0, "no joint 'wrist'; the joints are 0 shoulder, 1 elbow"),
        (TWO_LINKS, [2], 1.0, "no joint '2'"),
        (TWO_LINKS, [0, 1], 1.0, "all 2 joints have a motor"),
        (TWO_LINKS, [], 1.0, "no joint has a motor"),
        (TWO_LINKS, [1], None, "states no limit of the motor of joint 'elbow'"),
        (TWO_LINKS.replace('axis="0 1 0"', 'axis="0 0 1"'), [0], 1.0, "gravity does not move the passive joint 1"),
        ("<mujoco><worldbody><body/></mujoco>", [0], 1.0, "MuJoCo refuses the model"),
        (f"<mujoco><worldbody><body><joint/>{ROD}</body></worldbody></mujoco>", [0], 1.0, "has 1 joint"),
        (CART_POLE.replace(SLIDE, 'type="ball"'), [1], 1.0, "neither a hinge"),
        (STANDING, [], None, "'hinge' cannot hang within its range of -1.571 to 1.571"),
    ],
    ids=["name", "number", "actuated", "none", "limit", "gravity", "xml", "single", "ball", "stop"],
)  # fmt: skip
def test_a_file_that_is_no_plant_is_one_line(file, actuated, control, message):
    with pytest.raises(InputError, match=message):
        mujoco_plant(file, actuated, control=control)


URDF = """<robot name="acrobot"><link name="base"/>
<link name="upper"><inertial><origin xyz="0 0 -.15"/><mass value=".5"/>
<inertia ixx=".004" ixy="0" ixz="0" iyy=".003" iyz="0" izz=".002"/></inertial>
<collision><geometry><box size="1 1 1"/></geometry></collision></link>
<link name="lower"><inertial><origin xyz="0 0 -.2"/><mass value=".4"/>
<inertia ixx=".005" ixy="0" ixz="0" iyy=".005" iyz="0" izz=".001"/></inertial></link>
<joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 -.3"/>
<axis xyz="0 1 0"/><limit lower="-2.9" upper="2.8" effort="2.5" velocity="25"/></joint></robot>"""


def test_a_urdf_plant_has_the_masses_and_the_limits_of_its_file(tmp_path):
    file = tmp_path / "acrobot.urdf"
    file.write_text(URDF)
    plant = guarded(mujoco_plant(file, ["elbow"], rate=500.0, seed=1))
    limits = plant.layout.limits
    np.testing.assert_array_equal(limits.control, [[-2.5, 2.5]])
    np.testing.assert_array_equal(limits.position, [[-np.inf, np.inf], [-2.9, 2.8]])
    np.testing.assert_array_equal(limits.rate, [np.inf, 25.0])
    step = integrated(field_of(dynamics(tree_system(read_robot(file).tree)), plant.layout.actuation), 1 / 500)
    plant.reset()
    x = jnp.concatenate([plant.read(), jnp.zeros(2)])
    for _ in range(3):
        plant.act([2.0])
        x = step(x, jnp.array([2.0]))
        np.testing.assert_allclose(plant.read(), x[:2], rtol=1e-9)


def test_transmissions_state_the_motors_of_a_urdf_that_hangs_from_a_world(tmp_path):
    file = tmp_path / "acrobot.urdf"
    motor = '<transmission name="motor"><joint name="elbow"/><actuator name="any"/></transmission>'
    weld = '<joint name="weld" type="fixed"><parent link="world"/><child link="base"/></joint>'
    file.write_text(URDF.replace("</robot>", f"{motor}{weld}</robot>"))
    layout = mujoco_plant(file).layout
    np.testing.assert_array_equal(layout.actuation, [[0.0], [1.0]])
    assert layout.names == ("shoulder", "elbow")


def test_a_urdf_plant_with_a_link_of_no_mass_is_one_line(tmp_path):
    file = tmp_path / "light.urdf"
    start, end = URDF.rindex("<inertial>"), URDF.rindex("</inertial>") + len("</inertial>")
    file.write_text(URDF[:start] + URDF[end:])
    with pytest.raises(InputError, match="mass and inertia of moving bodies"):
        mujoco_plant(file, ["elbow"])


def test_a_sample_is_a_whole_number_of_steps():
    with pytest.raises(InputError, match=r"a sample has 1.667 steps"):
        mujoco_plant(CART_POLE, rate=300.0)
