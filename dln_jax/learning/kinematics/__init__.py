"""Fits trees of unknown kinematics: joint frames by Gauss-Newton from random starts, all else by elimination.

fit = fit_tree(needs, train, validation)
make_serial_tree(needs).energies(fit.parameters)
"""

from dln_jax.learning.kinematics.fit import TreeFit, fit_tree
from dln_jax.learning.kinematics.frames import Frames, mirrored, random_frames, rough_frames, turned_round
from dln_jax.learning.kinematics.search import Search
from dln_jax.learning.kinematics.sketch import Sketch, frames_of_axes, sketch_from_json

__all__ = [
    "Frames",
    "Search",
    "Sketch",
    "TreeFit",
    "fit_tree",
    "frames_of_axes",
    "mirrored",
    "random_frames",
    "rough_frames",
    "sketch_from_json",
    "turned_round",
]
