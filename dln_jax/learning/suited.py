"""The structured network, its optimiser and its samples that suit an arm of many joints.

Measured on a simulated arm of seven axes, nMSE on unseen motions and processor time, one core of two:

    15 motions of 10 s   8 x 8 by Gauss-Newton on all samples, as for few joints   TABLE

A step of Gauss-Newton forms JᵀJ, some N d P² operations, and samples of one motion that follow each other closely say
the same: a part of them is enough. What limits a small network is what it can hold, and a large one what the motions
show: the number of equations that are independent decides.
"""

from typing import NamedTuple

import jax
import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.learning.uncertainty import effective_samples
from dln_jax.models.lagrangian import make_delan
from dln_jax.solvers.normal_equations import count
from dln_jax.types import Needs

MANY_JOINTS = 4
"""Fewer have a small network and all their samples."""
WIDTH = 16
"""Of the one hidden layer that mass matrix and potential share."""
ROWS_PER_PARAMETER = 14
"""Equations that a step of Gauss-Newton sees; from seven on, errors on unseen motions were the same."""
MOST_INDEPENDENT = 6
"""Independent equations for each parameter of the small network, above which a large one by Adam is better."""


class Suited(NamedTuple):
    """Of a structured network."""

    optimizer: str
    """gauss-newton or adam."""
    keywords: dict[str, int | bool]
    """Of `make_delan`: width, depth, and whether there is one trunk."""
    samples: int | None
    """Drawn for the fit; `None` for all."""
    reason: str


def suited_network(needs: Needs, train: Trajectories) -> Suited:
    """For joints that are many, by the needs and by how much the training motions say."""
    d = needs.degrees_of_freedom
    small = {"width": WIDTH, "depth": 1, "shared_trunk": True}
    size = count(jax.eval_shape(make_delan(needs, **small).init, jax.random.key(0)))
    independent = independent_equations(train)
    told = f"{independent:,} independent equations for the {size:,} parameters of a small network"
    if independent > MOST_INDEPENDENT * size:
        large = {"width": 64, "depth": 2, "shared_trunk": False}
        return Suited("adam", large, None, f"{told}: a large one holds more")
    samples = ROWS_PER_PARAMETER * size // d
    drawn = f"; {samples:,} of {len(train.t):,} samples are fitted" if samples < len(train.t) else ""
    return Suited("gauss-newton", small, samples, told + drawn)


def independent_equations(data: Trajectories) -> int:
    """d times the number of independent samples that say as much, by the accelerations of a typical joint.

    It stays the same where motions are sampled more often.
    """
    counts = [effective_samples(column - column.mean(), data.trajectory) for column in data.qdd.T]
    return round(data.degrees_of_freedom * float(np.median(counts)))
