"""The simulated arm obeys our mechanics, and errors are held against the rival's and true parameters."""

import jax
import numpy as np
import pytest

from dln_jax import dynamics, joint_dissipation, tree_system
from dln_jax.mechanics.trees.inertia import pseudo_inertia
from scripts.reports.robots.arm import EVERY, Motion, arm, exact_torque, follow, motion
from scripts.reports.robots.known_kinematics import summary


@pytest.fixture(scope="module")
def short():
    wanted = motion(np.random.default_rng(0))
    return Motion(*(each[:800] for each in wanted))


def test_forces_of_a_log_are_those_of_the_tree(short):
    robot = arm(coulomb=False)
    q, qd, qdd, tau, _ = follow(robot, short)
    system = dynamics(tree_system(robot.tree, joint_dissipation(robot.damping)))
    assert len(q) == len(short.q) // EVERY
    np.testing.assert_allclose(jax.jit(jax.vmap(system.inverse_dynamics))(q, qd, qdd), tau, atol=1e-10)


def test_fed_forward_torque_tracks(short):
    robot = arm(coulomb=True)
    error = lambda log: np.sqrt(np.mean((log[0] - log[4]) ** 2))  # noqa: E731
    assert error(follow(robot, short, exact_torque(robot, short))) < 1e-2 * error(follow(robot, short))


def test_links_are_physically_consistent():
    assert all(np.linalg.eigvalsh(pseudo_inertia(theta)).min() > 0 for theta in arm(coulomb=False).tree.inertias)


def test_errors_are_relative_to_the_rival_and_to_true_parameters():
    numbers = summary(
        {"ours": [1e-3, 2e-3], "pinocchio": [2e-3, 2e-3]},
        {"true-parameters": [1.0, 2.0], "ours": [1.2, 2.4], "without": [20.0, 30.0]},
    )
    assert numbers["arm/noisy-coulomb/ours"] == pytest.approx(
        {"nmse": 1.5e-3, "nmse_worst": 2e-3, "over_pinocchio": 0.75}
    )
    assert numbers["arm/tracking/ours"]["over_true_parameters"] == pytest.approx(1.2)
    assert "over_true_parameters" not in numbers["arm/tracking/without"]
