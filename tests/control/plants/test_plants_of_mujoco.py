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


MOTOR = '<motor joint="rail" gear="2" ctrllimited="true" ctrlrange="-5 5"/>'
SITED = CART_POLE.replace("<geom type", '<site name="crank" pos=".1 0 0"/><site name="slider"/><geom type', 1)
TENDON = '<tendon><fixed name="t"><joint joint="rail" coef="1"/><joint joint="hinge" coef=".2"/></fixed></tendon>'


@pytest.mark.parametrize(
    ("actuator", "reason"),
    [
        ('<position name="it" joint="rail" kp="100" ctrlrange="-1 1"/>', "biastype"),
        ('<velocity name="it" joint="rail" kv="10"/>', "biastype"),
        ('<intvelocity name="it" joint="rail" kp="10" actrange="-1 1"/>', "dyntype"),
        ('<damper name="it" joint="rail" kv="1" ctrlrange="0 1"/>', "gaintype"),
        ('<cylinder name="it" joint="rail" timeconst="1" area="1"/>', "dyntype"),
        ('<muscle name="it" joint="rail" lengthrange="0 1"/>', "dyntype"),
        ('<general name="it" joint="rail" dyntype="filter" dynprm=".1"/>', "dyntype"),
        ('<general name="it" joint="rail" dyntype="integrator"/>', "dyntype"),
        ('<general name="it" joint="rail" gaintype="affine"/>', "gaintype"),
        ('<motor name="it" tendon="t"/>', "transmission"),
        ('<motor name="it" site="slider" gear="1 0 0"/>', "transmission"),
        ('<motor name="it" slidersite="slider" cranksite="crank" cranklength=".3"/>', "transmission"),
        ('<adhesion name="it" body="cart" ctrlrange="0 1"/>', "transmission"),
        ('<motor name="it" joint="rail" gear="1 2"/>', "gear"),
        ('<motor name="it" joint="rail" gear="0"/>', "gear"),
        (MOTOR + '<motor name="it" joint="rail"/>', "another actuator"),
    ],
)
@pytest.mark.parametrize("control", [None, 3.0])
def test_an_actuator_that_is_not_a_plain_motor_is_refused_by_name(actuator, reason, control):
    file = SITED.replace(MOTOR, actuator).replace("<worldbody><body>", '<worldbody><body name="cart">')
    file = file.replace("<actuator>", f"{TENDON}<actuator>")
    with pytest.raises(InputError, match=f"actuator 'it' is not a plain motor of a joint .*{reason}"):
        mujoco_plant(file, [] if control is None else ["rail"], control=control)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("</actuator>", '</actuator><equality><joint joint1="rail" joint2="hinge"/></equality>', "close loops"),
        ('name="hinge"', 'name="hinge" stiffness="1"', "joint 'hinge' has a spring"),
        ("<body><joint name", '<body gravcomp="1"><joint name', "the file has gravity compensation"),
        ("<mujoco>", '<mujoco><option wind="1 0 0" density="1"/>', "the file has wind"),
        ("<mujoco>", '<mujoco><option><flag actuation="disable"/></option>', "the file has disabled actuators"),
        ("<mujoco>", '<mujoco><option actuatorgroupdisable="0"/>', "the file has disabled actuators"),
        ("<worldbody>", '<worldbody><geom size=".04"/>', "bodies 'world' and 'cart' touch at the goal"),
        ("<mujoco>", '<mujoco><option timestep="0"/>', "the time step of the model is 0 s"),
        ("<mujoco>", '<mujoco><option timestep="nan"/>', "the time step of the model is nan s"),
        ("<mujoco>", '<mujoco><option timestep="inf"/>', "the time step of the model is inf s"),
        ("<mujoco>", '<mujoco><option gravity="0 0 nan"/>', "gravity has nan"),
        ('name="hinge"', 'name="hinge" damping="nan"', "the damping of joint 'hinge' is nan"),
        ("-.5 .5", "nan .5", "joint 'rail' has limits of position nan, 0.5"),
        (" limited", ' class="it" limited', "joint 'rail' has limits of torque nan, 1"),
        ('"-5 5"', '"nan 5"', "actuator '0' has limits nan to 5"),
        ('"-5 5"', '"0 5"', "actuator '0' has limits 0 to 5"),
        ('"-5 5"', '"-5 5" forcerange="5 -5"', "actuator '0' has limits 5 to -5"),
        (MOTOR, "", "no joint has a motor: the file has no actuator"),
    ],
)
def test_a_plant_that_motors_and_gravity_do_not_explain_is_refused(before, after, message):
    default = '<default><default class="it"><joint actuatorfrcrange="nan 1"/></default></default><worldbody><body name='
    file = CART_POLE.replace("<worldbody><body>", f'{default}"cart">').replace("<body><joint", "<body><joint", 1)
    assert before in file
    with pytest.raises(InputError, match=message):
        mujoco_plant(file.replace(before, after, 1))


@pytest.mark.parametrize(
    ("motor", "joint", "force"),
    [
        ('<motor joint="rail" gear="-2" ctrlrange="-5 6"/>', "", 10.0),
        ('<general joint="rail" gear="2" gainprm="3" ctrlrange="-5 5"/>', "", 30.0),
        ('<general joint="rail" gear="2" gainprm="3" ctrlrange="-5 5" forcerange="-8 4"/>', "", 8.0),
        ('<motor joint="rail" gear="2" ctrlrange="-5 5" forcerange="-80 80"/>', "", 10.0),
        ('<motor joint="rail" gear="2" ctrlrange="-5 5"/>', 'actuatorfrcrange="-7 9"', 7.0),
    ],
)
def test_a_motor_gives_the_force_that_is_asked_for_within_all_limits_of_its_file(motor, joint, force):
    file = CART_POLE.replace(MOTOR, motor).replace('name="rail"', f'name="rail" {joint}')
    plant, bare = mujoco_plant(file, seed=2), mujoco_plant(CART_POLE.replace(MOTOR, ""), ["rail"], control=99, seed=2)
    np.testing.assert_allclose(plant.layout.limits.control, [[-force, force]])
    for one in (plant, bare):
        one.reset()
        for share in (1.0, -1.0, 0.5):
            one.act([share * force])
    np.testing.assert_allclose(plant.read(), bare.read(), rtol=1e-12)
    with pytest.raises(InputError, match=f"the file limits the motor of joint 'rail' to {force:g}"):
        mujoco_plant(file, control=force + 1)


@pytest.mark.parametrize(("gravity", "rail", "middle"), [("1e-5", "-.5 .5", 0.0), ("0.1", "0 1", 0.5)])
def test_a_slide_stays_in_the_middle_of_its_range_on_a_tilted_rail(gravity, rail, middle):
    file = CART_POLE.replace("-.5 .5", rail).replace("<mujoco>", f'<mujoco><option gravity="{gravity} 0 -9.81"/>')
    layout = mujoco_plant(file).layout
    tilt = np.arctan2(float(gravity), 9.81)
    np.testing.assert_allclose(layout.hanging, [middle, -tilt], atol=1e-5)
    np.testing.assert_allclose([layout.goal[0], abs(layout.goal[1])], [middle, np.pi - tilt], atol=1e-5)
    with pytest.raises(InputError, match="nothing holds the passive slide 0"):
        mujoco_plant(file.replace(MOTOR, ""), ["hinge"], control=1.0)


def test_the_settings_of_mujoco_in_a_urdf_are_those_of_the_plant(tmp_path):
    file = tmp_path / "moon.urdf"
    settings = '<mujoco><option gravity="0 0 -1.6" timestep="0.004" integrator="Euler"/></mujoco>'
    file.write_text(URDF.replace("</robot>", f"{settings}</robot>"))
    assert mujoco_plant(file, ["elbow"]).layout.rate == 250.0
    np.testing.assert_array_equal(read_robot(file).tree.gravity, [0.0, 0.0, -1.6])
