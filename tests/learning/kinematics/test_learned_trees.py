"""Arms of two and three joints are found from nothing but their motions and torques, down to the noise."""

import jax
import numpy as np
import pytest

from dln_jax.data.splits import select
from dln_jax.learning.kinematics import Search, fit_tree, rough_frames
from dln_jax.learning.kinematics.frames import Frames
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import make_tree
from dln_jax.models.serial_tree import make_serial_tree
from dln_jax.types import InputError
from scripts.reports.robots.simulated_arms import lip_trajectories, skew_arm, sliding_arm

NOISE = 0.01


def part(arm, d):
    """The arm without its links from the d-th."""
    tree = arm.tree
    cut = make_tree(*(each[:d] for each in tree[:6]), armature=tree.armature[:d])
    return arm._replace(tree=cut, **{name: getattr(arm, name)[:d] for name in arm._fields[2:]})


SKEW, SLIDING = part(skew_arm(), 2), part(sliding_arm(), 3)
SETTINGS = Search(starts=16, agreement=3, samples=60, iterations=60)
SHARP = {"velocity_scale": 1e-3}
"""Dry friction of the arms changes its sign at once."""


def root_mean_square(arm, fit, needs, seed=5):
    """Error at a motion that was not seen, without noise."""
    test = lip_trajectories(arm, (seed,), friction=needs.friction, noise=0.0, every=100)
    system = make_serial_tree(needs, **SHARP).energies(fit.parameters)
    found = jax.jit(jax.vmap(dynamics(system).inverse_dynamics))(test.q, test.qd, test.qdd)
    return np.sqrt(np.mean((np.asarray(found) - test.tau) ** 2))


@pytest.mark.slow
def test_an_arm_is_found_down_to_the_noise():
    data = lip_trajectories(SKEW, (0, 1), friction=True, noise=NOISE, every=50)
    said = []
    train, validation = (select(data, [index]) for index in range(2))
    fit = fit_tree(data.needs, train, validation, settings=SETTINGS, report=said.append, **SHARP)
    assert fit.agreeing >= 3 and len(said) == 2 and "descents" in said[0] and "found the same arm" in said[1]
    assert fit.twin is not None and fit.twin.same
    errors = np.sqrt(fit.joint_mse)
    assert errors.min() > 0.7 * NOISE and errors.max() < 1.3 * NOISE
    assert fit.rank <= fit.parameter_count
    assert fit.torque_mse < fit.validation_error < 4 * fit.torque_mse
    assert root_mean_square(SKEW, fit, data.needs) < NOISE


@pytest.mark.slow
def test_from_a_kinematic_prior_a_sliding_arm_is_found():
    data = lip_trajectories(SLIDING, noise=NOISE, every=60)
    exact = Frames(SLIDING.tree.rotations, SLIDING.tree.positions)
    kinematic_prior = rough_frames(exact, np.random.default_rng(0), angle=0.3, length=0.02)
    fit = fit_tree(
        data.needs, data, settings=SETTINGS._replace(kinematic_prior=kinematic_prior, prior_angle=0.2), **SHARP
    )
    assert np.sqrt(fit.joint_mse).max() < 1.2 * NOISE
    assert np.isnan(fit.validation_error)
    assert root_mean_square(SLIDING, fit, data.needs) < NOISE


def test_what_cannot_be_is_refused():
    data = lip_trajectories(SLIDING, every=500)
    with pytest.raises(InputError, match="joints"):
        fit_tree(data.needs._replace(joints=("revolute",)), data)
    with pytest.raises(InputError, match="starts"):
        fit_tree(data.needs, data, settings=Search(starts=0))
    with pytest.raises(InputError, match="parents"):
        fit_tree(data.needs, data, parents=(0, 0, 0))
