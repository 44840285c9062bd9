"""Checks neither explain a log by an impossible robot, nor blame units and clocks for what a robot's file lacks."""

from pathlib import Path

import jax
import numpy as np
import pytest

from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import train_delan
from dln_jax.cli.encoders import prepare_log
from dln_jax.data import schema
from dln_jax.data.checks import as_recording, examine, quick
from dln_jax.data.checks.channels import flat_share
from dln_jax.data.robots import Robot
from dln_jax.mechanics import trees

WIDE = np.tile([-np.inf, np.inf], (2, 1))
UPRIGHT, LYING = (0.0, -9.81, 0.0), (0.0, 0.0, -9.81)
TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])


def arm(gravity, wrist=1.0):
    """Two joints with parallel axes, as the first two of a SCARA if gravity is along them."""
    links = [trees.inertial_parameters(mass, [0.2, 0.01, 0], mass * 0.02 * np.eye(3)) for mass in (3.0, 1.5 * wrist)]
    tree = trees.serial(*trees.dh_frames([[0, 0, 0, 0], [0, 0.4, 0, 0]]), links, gravity=gravity)
    return Robot(tree, np.zeros(2), np.zeros(2), WIDE, WIDE)


def log(force, rate=100.0, runs=3, seconds=8.0, seed=0):
    """Arrays of a log with sums of sines, torques force(q, qd, qdd) and 0.5 % of noise in them."""
    random = np.random.default_rng(seed)
    t = np.arange(int(seconds * rate)) / rate
    w, phase = random.uniform(1, 6, (runs, 2, 4)), random.uniform(0, 6.3, (runs, 2, 4))
    angles = w[:, None] * t[:, None, None] + phase[:, None]
    a = random.uniform(0.3, 0.6, (runs, 1, 2, 4)) / w[:, None] ** 0.5
    parts = [a * np.sin(angles), a * w[:, None] * np.cos(angles), -a * w[:, None] ** 2 * np.sin(angles)]
    q, qd, qdd = (part.sum(axis=3).reshape(-1, 2) for part in parts)
    tau = force(q, qd, qdd)
    tau = tau + 5e-3 * tau.std(axis=0) * random.normal(size=tau.shape)
    return {"t": np.tile(t, runs), "q": q, "tau": tau, "trajectory": np.repeat(np.arange(runs), len(t))}


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


@pytest.mark.parametrize("gravity", [UPRIGHT, LYING])
def test_torques_that_are_all_reversed_are_found_with_the_robot(gravity):
    found = errors(reversed_at(log(torques(arm(gravity))), 0, 1), arm(gravity))
    assert [(finding.check, finding.joints) for finding in found] == [("tree-sign", (0, 1))]


@pytest.mark.parametrize("with_robot", [True, False])
@pytest.mark.parametrize("joint", [0, 1])
def test_the_joint_whose_torque_is_reversed_is_blamed(joint, with_robot):
    """Turning the other joint's torque explains a SCARA as well, with a negative definite inertia."""
    robot = arm(LYING) if with_robot else None
    sound = log(torques(arm(LYING), rotors=(0.2, 0.1)))
    assert errors(sound, robot) == []
    assert [finding.joints for finding in errors(reversed_at(sound, joint), robot)] == [(joint,)]


@pytest.mark.parametrize(
    "force",
    [
        lambda q, qd, qdd: qdd - 1.0 * qd @ TURN.T + 0.5 * q,
        lambda q, qd, qdd: qdd - 5.0 * qd @ TURN.T + 0.5 * q,
        lambda q, qd, qdd: qdd * [0.2, 0.3] - 4 * qd @ TURN.T + np.sin(q),
    ],
    ids=["field", "strong-field", "gimbals"],
)
def test_gyroscopic_forces_are_no_exchanged_torques(force):
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


def test_commands_and_check_data_find_the_same():
    data = schema.from_arrays(reversed_at(log(torques(arm(UPRIGHT))), 0))
    robot = arm(UPRIGHT)
    assert quick(data, robot) == examine(as_recording(data), robot).findings != []


def test_torques_late_by_200_ms_are_found_at_20_hz():
    slow = log(lambda q, qd, qdd: np.array([2.0, 1.0]) * qdd + 3 * np.sin(q), rate=20.0, seconds=20.0)
    runs = slow["tau"].reshape(3, -1, 2)
    late = np.concatenate([np.repeat(runs[:, :1], 4, axis=1), runs[:, :-4]], axis=1).reshape(-1, 2)
    found = [finding for finding in quick(schema.from_arrays({**slow, "tau": late})) if finding.check == "delay"]
    assert len(found) == 1 and abs(float(found[0].observation.split()[2]) - 200) < 15


def test_steps_of_a_smooth_extreme_are_not_cut_off():
    t = np.arange(2000) / 200
    same = np.zeros(2000, int)
    angle, torque = np.sin(2 * t), 5 * np.sin(3 * t)
    step = 2 * np.pi / 4096
    assert flat_share(np.round(angle / step) * step, same) == 0
    assert flat_share(np.round(torque / 0.5) * 0.5, same) == 0
    assert flat_share(np.round(4 * np.sin(12 * t + 0.03) / 0.05) * 0.05, same) == 0
    clipped = np.clip(torque, -3.0, 3.0)
    assert flat_share(clipped, same) > 0.1
    assert flat_share(np.round(clipped / 0.01) * 0.01, same) > 0.1
