"""Errors after designed and random motions are what theory says of them."""

import jax
import numpy as np

from dln_jax.identification.excitation.design import assess, random_designs
from dln_jax.identification.excitation.limits import MotionLimits
from dln_jax.identification.excitation.task import make_task
from dln_jax.mechanics.trees.description import dh_frames, serial
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.models.trees import make_rigid_tree
from scripts.reports.robots.known_kinematics import error_ratios

LINK = inertial_parameters(1.0, [0.2, 0.0, 0.0], 0.01 * np.eye(3))
ARM = serial(*dh_frames([[-np.pi / 2, 0, 0, 0]]), [LINK])
FREE = np.array([[-np.inf, np.inf]])


def test_a_wider_motion_errs_less_and_the_same_not_at_all():
    model = make_rigid_tree(ARM, friction=True, velocity_scale=0.05)
    limits = MotionLimits(np.array([[-2.0, 2.0]]), np.array([3.0]), np.array([20.0]), FREE)
    task = make_task(model, model.init(jax.random.key(0)), limits, period=5.0, harmonics=3, noise=0.1)
    wide = random_designs(task, 2)
    assert (error_ratios(wide, wide, seeds=4) == 1.0).all()
    # Half as far: a sixteenth of the information of some parameters.
    narrow = [
        assess(task, design.motion._replace(coefficients=0.5 * np.asarray(design.motion.coefficients)))
        for design in wide
    ]
    ratios = error_ratios(wide, narrow, seeds=20)
    assert np.median(ratios) < 0.8 and ratios.shape == (20,)
    assert np.median(error_ratios(narrow, wide, seeds=20)) > 1.2
