"""Checks neither explain a log by an impossible robot, nor blame units and clocks for what a robot's file lacks."""

from pathlib import Path

import jax
import numpy as np
import pytest

from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import train_delan
from dln_jax.cli.encoders import prepare_log
from dln_jax.data import schema
from dln_jax.data.checks import quick
from dln_jax.data.checks.channels import flat_share
from dln_jax.data.robots import Robot
from dln_jax.mechanics import trees
from tests.motions import sums_of_sines

WIDE = np.tile([-np.inf, np.inf], (2, 1))
UPRIGHT, LYING = (0.0, -9.81, 0.0), (0.0, 0.0, -9.81)
TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])


def arm(gravity, wrist=1.0):
    """Two joints with parallel axes, as the first two of a SCARA if gravity is along them."""
    links = [trees.inertial_parameters(mass, [0.2, 0.01, 0], mass * 0.02 * np.eye(3)) for mass in (3.0, 1.5 * wrist)]
    tree = trees.serial(*trees.dh_frames([[0, 0, 0, 0], [0, 0.4, 0, 0]]), links, gravity=gravity)
    return Robot(tree, np.zeros(2), np.zeros(2), WIDE, WIDE)


def log(force, rate=100.0, runs=3, seconds=8.0):
    """Arrays of a log with sums of sines, torques force(q, qd, qdd) and 0.5 % of noise in them."""
    random = np.random.default_rng(0)
    t = np.tile(np.arange(int(seconds * rate)) / rate, runs)
    rates, phases = (random.uniform(*bounds, (runs, 2, 4)) for bounds in ((1, 6), (0, 6.3)))
    sizes = random.uniform(0.3, 0.6, (runs, 2, 4)) / rates**0.5
    trajectory = np.repeat(np.arange(runs), len(t) // runs)
    q, qd, qdd = sums_of_sines(t, *(numbers[trajectory] for numbers in (sizes, rates, phases)))
    tau = force(q, qd, qdd)
    return {
        "t": t,
        "q": q,
        "tau": tau + 5e-3 * tau.std(axis=0) * random.normal(size=tau.shape),
        "trajectory": trajectory,
    }


def torques(robot, rotors=(0.0, 0.0)):
    """Inverse dynamics of a robot with these rotors and viscous friction."""
    tree = robot.tree._replace(armature=np.array(rotors))
    inverse = jax.jit(jax.vmap(lambda *state: trees.newton_euler(tree, *state)))
    return lambda q, qd, qdd: np.asarray(inverse(q, qd, qdd)) + 0.1 * qd


def errors(arrays, robot=None):
    return [finding for finding in quick(schema.from_arrays(arrays), robot) if finding.severity == "error"]


def reversed_at(arrays, *joints):
    signs = np.where(np.isin(np.arange(2), joints), -1.0, 1.0)
    return {**arrays, "tau": arrays["tau"] * signs}


def test_torques_that_are_all_reversed_are_found_with_the_robot():
    for gravity in (UPRIGHT, LYING):
        found = errors(reversed_at(log(torques(arm(gravity))), 0, 1), arm(gravity))
        assert [(finding.check, finding.joints) for finding in found] == [("tree-sign", (0, 1))]


@pytest.mark.parametrize("robot", [arm(LYING), None], ids=["with robot", "without"])
def test_the_joint_whose_torque_is_reversed_is_blamed(robot):
    """Turning the other joint's torque explains a SCARA as well, with a negative definite inertia."""
    sound = log(torques(arm(LYING), rotors=(0.2, 0.1)))
    assert errors(sound, robot) == []
    for joint in (0, 1):
        assert [finding.joints for finding in errors(reversed_at(sound, joint), robot)] == [(joint,)]


def test_gyroscopic_forces_are_no_exchanged_torques():
    for force in (
        lambda q, qd, qdd: qdd - 1.0 * qd @ TURN.T + 0.5 * q,
        lambda q, qd, qdd: qdd - 5.0 * qd @ TURN.T + 0.5 * q,
        lambda q, qd, qdd: qdd * [0.2, 0.3] - 4 * qd @ TURN.T + np.sin(q),  # gimbals
    ):
        assert errors(log(force)) == []


def test_rotors_that_a_file_lacks_are_no_gears_and_no_clock():
    robot = arm(UPRIGHT, wrist=0.02)
    sound = log(torques(robot, rotors=(1.5, 0.2)))
    assert errors(sound, robot) == []
    in_millinewtons = {**sound, "tau": 1000 * sound["tau"]}
    assert [finding.check for finding in errors(in_millinewtons, robot)] == ["gear"]


def test_torques_without_gravity_are_named_and_fitted_so():
    robot, lifted = arm(UPRIGHT), arm((0.0, 0.0, 0.0))
    data = schema.from_arrays(log(torques(lifted, rotors=(0.1, 0.1))))
    options = arguments_of(train_delan.Arguments, data=Path("log.npz"))
    _, lines, causes, measured = prepare_log(options, data, options.data, robot=robot)
    assert any("tau holds no gravity" in line for line in lines) and not any("clock" in line for line in lines)
    assert not any("gravity" in cause for cause in causes)
    assert not np.any(measured.tree.gravity) and np.array_equal(measured.tree.inertias, robot.tree.inertias)
    assert prepare_log(options, schema.from_arrays(log(torques(robot))), options.data, robot=robot)[-1] is robot


def test_torques_late_by_200_ms_are_found_at_20_hz():
    slow = log(lambda q, qd, qdd: np.array([2.0, 1.0]) * qdd + 3 * np.sin(q), rate=20.0, seconds=20.0)
    late = np.where(slow["t"][:, None] < 0.2, slow["tau"], np.roll(slow["tau"], 4, axis=0))
    found = [finding for finding in quick(schema.from_arrays({**slow, "tau": late})) if finding.check == "delay"]
    assert len(found) == 1 and abs(float(found[0].observation.split()[2]) - 200) < 15


def test_steps_of_a_smooth_extreme_are_not_cut_off():
    t = np.arange(2000) / 200
    torque = 5 * np.sin(3 * t)
    clipped = np.clip(torque, -3.0, 3.0)
    for values, step, cut in (
        (np.sin(2 * t), 2 * np.pi / 4096, False),
        (torque, 0.5, False),
        (4 * np.sin(12 * t + 0.03), 0.05, False),
        (clipped, 0.01, True),
        (clipped, 1e-9, True),
    ):
        share = flat_share(np.round(values / step) * step, np.zeros(2000, int))
        assert share > 0.1 if cut else share == 0
