"""An arm of two joints is found from nothing but its motions and torques, down to the noise."""

import jax
import numpy as np
from calls import one_line

from dln_jax.data.splits import select
from dln_jax.learning.kinematics.fit import fit_tree
from dln_jax.learning.kinematics.search import Search
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees.description import make_tree
from dln_jax.models.trees import make_serial_tree
from scripts.reports.robots.simulated_arms import lip_trajectories, skew_arm

NOISE = 0.01


def skew():
    """An arm of the first two links of the skew one."""
    arm = skew_arm()
    tree = make_tree(*(each[:2] for each in arm.tree[:6]), armature=arm.tree.armature[:2])
    rows = {name: value[:2] for name, value in arm._asdict().items() if isinstance(value, np.ndarray)}
    return arm._replace(tree=tree, **rows)


SKEW = skew()
SETTINGS = Search(starts=8, agreement=2, samples=60, iterations=60)
SHARP = {"velocity_scale": 1e-3}
"""Dry friction of the arms changes its sign at once."""


def test_an_arm_is_found_down_to_the_noise():
    data = lip_trajectories(SKEW, (0, 1), friction=True, noise=NOISE, every=50)
    said = []
    train, validation = (select(data, [index]) for index in range(2))
    fit = fit_tree(data.needs, train, validation, settings=SETTINGS, report=said.append, **SHARP)
    assert fit.agreeing >= 2 and len(said) == 2 and "starts" in said[0] and "starts agree" in said[1]
    assert fit.twin is not None and fit.twin.same
    errors = np.sqrt(fit.joint_mse)
    assert errors.min() > 0.7 * NOISE and errors.max() < 1.3 * NOISE
    assert fit.rank <= fit.parameter_count
    assert fit.torque_mse < fit.validation_error < 4 * fit.torque_mse
    test = lip_trajectories(SKEW, (5,), friction=True, noise=0.0, every=100)
    system = make_serial_tree(data.needs, **SHARP).energies(fit.parameters)
    found = jax.jit(jax.vmap(dynamics(system).inverse_dynamics))(test.q, test.qd, test.qdd)
    assert np.sqrt(np.mean((np.asarray(found) - test.tau) ** 2)) < NOISE, "at a motion that was not seen"


def test_what_cannot_be_is_refused():
    data = lip_trajectories(SKEW, every=500)
    for needs, options, message in [
        (data.needs._replace(joints=("revolute",)), {}, "joints"),
        (data.needs, {"settings": Search(starts=0)}, "starts"),
        (data.needs, {"parents": (0, 0)}, "parents"),
    ]:
        with one_line(message):
            fit_tree(needs, data, **options)
