"""Plants are read from files: layout, goal and limits, and mistakes in one line."""

import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax import tree_system
from dln_jax.control.closed_loop import Hardware
from dln_jax.control.plants.mujoco_plants import mujoco_plant
from dln_jax.control.plants.runs import guarded
from dln_jax.control.state_space import field_of, integrated
from dln_jax.data.robots import read_robot
from dln_jax.mechanics.equations import dynamics

ROD = '<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".01" mass=".2" contype="0" conaffinity="0"/>'
MOTOR = '<motor joint="rail" gear="2" ctrllimited="true" ctrlrange="-5 5"/>'
SLIDE = 'type="slide" axis="1 0 0" range="-.5 .5" limited="true"'
CART_POLE = f"""<mujoco><worldbody><body name="cart"><joint name="rail" {SLIDE}/>
<geom type="box" size=".05 .05 .05" mass="1"/><body><joint name="hinge" axis="0 1 0"/>{ROD}</body></body></worldbody>
<actuator>{MOTOR}</actuator></mujoco>"""
TWO_LINKS = f"""<mujoco><worldbody><body><joint name="shoulder" axis="0 1 0"/>{ROD}<body pos="0 0 -.3">
<joint name="elbow" axis="0 1 0"/>{ROD}</body></body></worldbody></mujoco>"""
URDF = """<robot name="acrobot"><link name="base"/>
<link name="upper"><inertial><origin xyz="0 0 -.15"/><mass value=".5"/>
<inertia ixx=".004" ixy="0" ixz="0" iyy=".003" iyz="0" izz=".002"/></inertial>
<collision><geometry><box size="1 1 1"/></geometry></collision></link>
<link name="lower"><inertial><origin xyz="0 0 -.2"/><mass value=".4"/>
<inertia ixx=".005" ixy="0" ixz="0" iyy=".005" iyz="0" izz=".001"/></inertial></link>
<joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 -.3"/>
<axis xyz="0 1 0"/><limit lower="-2.9" upper="2.8" effort="2.5" velocity="25"/></joint></robot>"""


def test_layout_of_a_cart_pole_comes_from_its_file():
    layout = mujoco_plant(CART_POLE).layout
    assert layout.joints == ("prismatic", "revolute") and layout.names == ("rail", "hinge") and layout.rate == 500.0
    assert_array_equal(layout.actuation, [[1.0], [0.0]])
    assert_array_equal(layout.limits.control, [[-10.0, 10.0]])
    assert_array_equal(layout.limits.position, [[-0.5, 0.5], [-np.inf, np.inf]])
    assert_allclose(layout.hanging, 0, atol=1e-6)
    assert_allclose(np.abs(layout.goal), [0, np.pi], atol=1e-6)


def test_controls_act_after_the_delay():
    def after(*controls):
        plant = guarded(mujoco_plant(TWO_LINKS, [1], control=1.0, hardware=Hardware(delay=2), seed=3))
        plant.reset()
        read = [plant.act([u]) or plant.read() for u in controls]
        assert plant.time() == pytest.approx(0.006)
        return read

    pushed = after(1.0, 0.0, 0.0)
    idle = after(0.0, 0.0, 0.0)
    assert_array_equal(pushed[:2], idle[:2])
    assert pushed[2][1] > idle[2][1]


WRONG_LINKS = [
    ({"actuated": ["wrist"]}, "no joint 'wrist'; the joints are 0 shoulder, 1 elbow"),
    ({"actuated": [2]}, "no joint '2'"),
    ({"actuated": [0, 1]}, "all 2 joints have a motor"),
    ({}, "no joint has a motor: the file has no actuator"),
    ({"actuated": [1], "control": None}, "has no limit for the motor of joint 'elbow'"),
    ({"source": TWO_LINKS.replace('axis="0 1 0"', 'axis="0 0 1"'), "actuated": [0]}, "gravity does not move the pass"),
    ({"source": f"<mujoco><worldbody><body><joint/>{ROD}</body></worldbody></mujoco>"}, "has 1 joint"),
]
WRONG_CART_POLES = [
    (SLIDE, 'type="ball"', "neither a hinge"),
    ("</actuator>", '</actuator><equality><joint joint1="rail" joint2="hinge"/></equality>', "close loops"),
    ('<body name="cart"', '<body name="cart" gravcomp="1"', "the file has gravity compensation"),
    ("<mujoco>", '<mujoco><option wind="1 0 0" density="1"/>', "the file has wind"),
    ("<mujoco>", '<mujoco><option><flag actuation="disable"/></option>', "the file has disabled actuators"),
    ("<mujoco>", '<mujoco><option actuatorgroupdisable="0"/>', "the file has disabled actuators"),
    ("<worldbody>", '<worldbody><geom size=".04"/>', "bodies 'world' and 'cart' touch at the goal"),
    ("<mujoco>", '<mujoco><option timestep="nan"/>', "the time step of the model is nan s"),
    ("<mujoco>", '<mujoco><option gravity="0 0 nan"/>', "gravity has nan"),
    ('name="hinge"', 'name="hinge" damping="nan"', "the damping of joint 'hinge' is nan"),
    ("-.5 .5", "nan .5", "joint 'rail' has limits of position nan, 0.5"),
    ("<mujoco>", '<mujoco><default><joint actuatorfrcrange="nan 1"/></default>', "'rail' has limits of torque nan, 1"),
    ('"-5 5"', '"0 5"', "actuator '0' has limits 0 to 5"),
    ('"-5 5"', '"-5 5" forcerange="5 -5"', "actuator '0' has limits 5 to -5"),
    # A pole that stands at zero and falls only to the level of its cart, as Gymnasium's.
    (f'"0 1 0"/>{ROD}', f'"0 1 0" range="-90 90"/>{ROD.replace("-.3", ".3")}', "'hinge' cannot hang"),
]
NOT_PLAIN_MOTORS = [
    ('<position name="it" joint="rail" kp="100" ctrlrange="-1 1"/>', "biastype"),
    ('<general name="it" joint="rail" dyntype="filter" dynprm=".1"/>', "dyntype"),
    ('<damper name="it" joint="rail" kv="1" ctrlrange="0 1"/>', "gaintype"),
    ('<adhesion name="it" body="cart" ctrlrange="0 1"/>', "transmission"),
    ('<motor name="it" joint="rail" gear="1 2"/>', "gear"),
    ('<motor name="it" joint="rail" gear="0"/>', "gear"),
    (MOTOR + '<motor name="it" joint="rail"/>', "another actuator"),
]


def test_files_that_are_no_plants_are_refused():
    for changed, message in WRONG_LINKS:
        with one_line(message):
            mujoco_plant(**{"source": TWO_LINKS, "control": 1.0, **changed})
    for before, after, message in WRONG_CART_POLES:
        assert before in CART_POLE
        with one_line(message):
            mujoco_plant(CART_POLE.replace(before, after, 1))
    for actuator, reason in NOT_PLAIN_MOTORS:
        with one_line(f"actuator 'it' is not a plain motor of a joint .*{reason}"):
            mujoco_plant(CART_POLE.replace(MOTOR, actuator), ["rail"], control=3.0)


def test_urdf_plant_has_the_masses_and_limits_of_its_file(tmp_path):
    file = tmp_path / "acrobot.urdf"
    file.write_text(URDF)
    plant = guarded(mujoco_plant(file, ["elbow"], rate=500.0, seed=1))
    limits = plant.layout.limits
    assert_array_equal(limits.control, [[-2.5, 2.5]])
    assert_array_equal(limits.position, [[-np.inf, np.inf], [-2.9, 2.8]])
    assert_array_equal(limits.rate, [np.inf, 25.0])
    step = integrated(field_of(dynamics(tree_system(read_robot(file).tree)), plant.layout.actuation), 1 / 500)
    plant.reset()
    x = jnp.concatenate([plant.read(), jnp.zeros(2)])
    for _ in range(3):
        plant.act([2.0])
        x = step(x, jnp.array([2.0]))
        assert_allclose(plant.read(), x[:2], rtol=1e-9)
    start = URDF.rindex("<inertial>")
    file.write_text(URDF[:start] + URDF[URDF.rindex("</link>") :])
    with one_line("mass and inertia of moving bodies"):
        mujoco_plant(file, ["elbow"])


def test_urdf_states_its_motors_by_transmissions_and_settings_of_mujoco(tmp_path):
    file = tmp_path / "acrobot.urdf"
    motor = '<transmission name="motor"><joint name="elbow"/><actuator name="any"/></transmission>'
    weld = '<joint name="weld" type="fixed"><parent link="world"/><child link="base"/></joint>'
    settings = '<mujoco><option gravity="0 0 -1.6" timestep="0.004" integrator="Euler"/></mujoco>'
    file.write_text(URDF.replace("</robot>", f"{motor}{weld}{settings}</robot>"))
    layout = mujoco_plant(file).layout
    assert_array_equal(layout.actuation, [[0.0], [1.0]])
    assert layout.names == ("shoulder", "elbow") and layout.rate == 250.0
    assert_array_equal(read_robot(file).tree.gravity, [0.0, 0.0, -1.6])


def test_motor_gives_the_force_asked_for_within_all_limits_of_its_file():
    for motor, joint, force in (
        ('<motor joint="rail" gear="-2" ctrlrange="-5 6"/>', "", 10.0),
        ('<general joint="rail" gear="2" gainprm="3" ctrlrange="-5 5" forcerange="-8 4"/>', "", 8.0),
        ('<motor joint="rail" gear="2" ctrlrange="-5 5" forcerange="-80 80"/>', "", 10.0),
        (MOTOR, 'actuatorfrcrange="-7 9"', 7.0),
    ):
        file = CART_POLE.replace(MOTOR, motor).replace('name="rail"', f'name="rail" {joint}')
        plant = mujoco_plant(file, seed=2)
        bare = mujoco_plant(CART_POLE.replace(MOTOR, ""), ["rail"], control=99, seed=2)
        assert_allclose(plant.layout.limits.control, [[-force, force]])
        for one in (plant, bare):
            one.reset()
            for share in (1.0, -1.0, 0.5):
                one.act([share * force])
        assert_allclose(plant.read(), bare.read(), rtol=1e-12)
        with one_line(f"the file limits the motor of joint 'rail' to {force:g}"):
            mujoco_plant(file, control=force + 1)


def test_slide_stays_in_the_middle_of_its_range_on_a_tilted_rail():
    for gravity, rail, middle in (("1e-5", "-.5 .5", 0.0), ("0.1", "0 1", 0.5)):
        file = CART_POLE.replace("-.5 .5", rail).replace("<mujoco>", f'<mujoco><option gravity="{gravity} 0 -9.81"/>')
        layout = mujoco_plant(file).layout
        tilt = np.arctan2(float(gravity), 9.81)
        assert_allclose(layout.hanging, [middle, -tilt], atol=1e-5)
        assert_allclose([layout.goal[0], abs(layout.goal[1])], [middle, np.pi - tilt], atol=1e-5)
        with one_line("nothing holds the passive slide 0"):
            mujoco_plant(file.replace(MOTOR, ""), ["hinge"], control=1.0)
