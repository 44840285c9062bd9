"""Fits trees of unknown kinematics: joint frames by Gauss-Newton from random starts, all else by elimination.

fit = fit_tree(needs, train, validation)
make_serial_tree(needs).energies(fit.parameters)
"""

from dln_jax.learning.kinematics.agreement import Difference, Twin, difference
from dln_jax.learning.kinematics.fit import TreeFit, fit_tree
from dln_jax.learning.kinematics.frames import (
    Frames,
    KinematicPrior,
    frames_of_axes,
    kinematic_prior_from_json,
    mirrored,
    random_frames,
    rough_frames,
    turned_round,
)
from dln_jax.learning.kinematics.search import Search

__all__ = [
    "Difference",
    "Frames",
    "KinematicPrior",
    "Search",
    "TreeFit",
    "Twin",
    "difference",
    "fit_tree",
    "frames_of_axes",
    "kinematic_prior_from_json",
    "mirrored",
    "random_frames",
    "rough_frames",
    "turned_round",
]
