"""A robot that is written as MJCF reads back as the same robot."""

import jax
import numpy as np
import pytest

from dln_jax.data.robot_files import mjcf
from dln_jax.data.robots import Robot, read_robot
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import inertial_parameters, make_tree, tree_system
from dln_jax.types import InputError

pytest.importorskip("mujoco", reason="MuJoCo reads the robot files; it is in the extra [robot]")
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])


def robot(mass=1.3):
    """A prismatic joint between two revolute ones, and a branch, depth first as MuJoCo orders joints."""
    bodies = [inertial_parameters(m, [0.1, -0.2, 0.05 * m], np.diag([0.02, 0.03, 0.04])) for m in (2.0, mass, 0.5, 0.7)]
    tree = make_tree(
        [-1, 0, 1, 0], ["revolute", "prismatic", "revolute", "revolute"], [TURN, np.eye(3), TURN.T, TURN @ TURN],
        np.arange(12.0).reshape(4, 3) / 10, [[0, 0, 1], [1, 0, 0], [0.6, 0, 0.8], [0, 1, 0]], bodies,
        armature=[0.1, 0.0, 0.2, 0.3], gravity=[1, -2, -9], names=("a", "b", "c", "d"),
    )  # fmt: skip
    limits = np.array([[-1, 2], [-0.1, 0.3], [-np.inf, np.inf], [-3, 3]])
    return Robot(tree, np.array([0.1, 0.2, 0.0, 0.3]), np.array([0.0, 0.4, 0.5, 0.6]), limits, 10 * limits)


def test_a_robot_survives_its_file(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(mjcf(robot()))
    again = read_robot(path)
    assert (again.tree.names, again.tree.parents, again.tree.joints) == (robot().tree[-1], *robot().tree[:2])
    for numbers, expected in zip(again[1:], robot()[1:], strict=True):
        np.testing.assert_array_equal(numbers, expected)
    state = np.random.default_rng(0).normal(size=(3, 4))
    forces = (jax.jit(dynamics(tree_system(each.tree)).inverse_dynamics)(*state) for each in (again, robot()))
    np.testing.assert_allclose(*forces, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "keywords", "message"),
    [
        ({"mass": 0.0}, {}, "the link of joint 'b' has a mass of 0 kg"),
        ({}, {"time_step": 0.0}, "time_step is 0.0; expected a positive number"),
    ],
)
def test_what_is_refused(arguments, keywords, message):
    with pytest.raises(InputError, match=message):
        mjcf(robot(**arguments), **keywords)
