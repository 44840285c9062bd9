"""The structured network, its optimiser and its samples that suit an arm of many joints.

Measured on the simulated arm of seven axes (`studies.robots.arm`, viscous friction, no noise), mean nMSE on twelve
unseen motions, each after half a minute of processor time; of two seeds where two numbers stand:

    motions of 10 s                                15               30      75
    independent equations a parameter               4                8      19
    16 units, Gauss-Newton, 1,480 samples    0.026, 0.035         0.025   0.024
    64 x 64, AdamW, all samples (6,000 steps) 0.062, 0.059        0.023   0.0075

From 15 motions wider and deeper small networks (16 x 16, 32) came to the same 0.025, slower, 8 units to 0.056, and a
ridge to no better. A step of Gauss-Newton forms JᵀJ, some N d P² operations, and neighbouring samples of one motion say
the same: a part of them is enough. A small network is limited by what it can hold, a large one by what the motions
show: the number of independent equations decides.
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
"""Equations that a step of Gauss-Newton sees. Of 16 x 16 units, seven did as well."""
MOST_INDEPENDENT = 6
"""Independent equations for each parameter of the small network, above which a large one by Adam is better."""


class Suited(NamedTuple):
    """Of a structured network."""

    optimizer: str
    """gauss-newton or adam."""
    keywords: dict[str, int | bool]
    """Of `make_delan`: width, depth, and whether there is one trunk."""
    steps: int
    """Of the optimiser: half a minute."""
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
        return Suited("adam", large, 6_000, None, f"{told}: a large one holds more")
    samples = ROWS_PER_PARAMETER * size // d
    drawn = f"; {samples:,} of {len(train.t):,} samples are fitted" if samples < len(train.t) else ""
    return Suited("gauss-newton", small, 40, samples, told + drawn)


def independent_equations(data: Trajectories) -> int:
    """d times the number of independent samples that say as much, by the accelerations of a typical joint.

    It stays the same where motions are sampled more often.
    """
    counts = [effective_samples(column - column.mean(), data.trajectory) for column in data.qdd.T]
    return round(data.degrees_of_freedom * float(np.median(counts)))
