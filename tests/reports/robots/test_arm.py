"""The simulated arm obeys our mechanics, and its logs know what they should."""

import jax
import numpy as np
import pytest

from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees import pseudo_inertia, tree_system
from scripts.reports.robots.arm import EVERY, D, Motion, arm, exact_torque, follow, measured, motion, trajectories

pytest.importorskip("mujoco", reason="MuJoCo reads the robot files; it is in the extra [robot]")


@pytest.fixture(scope="module")
def short():
    wanted = motion(np.random.default_rng(0))
    return Motion(*(each[:800] for each in wanted))


def test_forces_of_a_log_are_those_of_the_tree(short):
    robot = arm(coulomb=False)
    data = trajectories([follow(robot, short)])
    system = dynamics(tree_system(robot.tree, joint_dissipation(robot.damping)))
    tau = jax.jit(jax.vmap(system.inverse_dynamics))(data.q, data.qd, data.qdd)
    assert data.q.shape == (len(short.q) // EVERY, D)
    np.testing.assert_allclose(tau, data.tau, atol=1e-10)


def test_fed_forward_torque_tracks_and_dry_friction_costs(short):
    robot = arm(coulomb=True)
    error = lambda log: np.sqrt(np.mean((log.q - log.reference) ** 2))  # noqa: E731
    alone, fed = follow(robot, short), follow(robot, short, exact_torque(robot, short))
    assert error(fed) < 1e-2 * error(alone)


def test_links_are_bodies_that_exist():
    assert all(np.linalg.eigvalsh(pseudo_inertia(theta)).min() > 0 for theta in arm(coulomb=False).tree.inertias)


def test_a_measured_log_has_no_rates(short):
    data = trajectories([follow(arm(coulomb=True), short)])
    log = measured(data, np.random.default_rng(0))
    assert set(log) == {"t", "q", "tau", "trajectory", "label"}
    assert 0 < np.abs(log["q"] - data.q).max() < 1e-3
