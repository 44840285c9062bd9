"""Chooses the structured network, its optimiser and its number of samples for an arm of many joints.

Measured on the simulated arm of seven axes (`studies.robots.arm`, viscous friction, no noise): mean nMSE on twelve
unseen motions after half a minute of processor time; two numbers are two seeds.

    motions of 10 s                                15               30      75
    independent equations a parameter               4                8      19
    16 units, Gauss-Newton, 1,480 samples    0.026, 0.035         0.025   0.024
    64 x 64, AdamW, all samples (6,000 steps) 0.062, 0.059        0.023   0.0075

With 15 motions, wider and deeper small networks (16 x 16, 32) reached the same 0.025 more slowly, 8 units reached
0.056, and a ridge did not help. A step of Gauss-Newton forms JᵀJ in about N d P² operations, and neighbouring samples
of a motion are redundant: a part of them is enough. Its capacity limits a small network, the information in the motions
a large one: the number of independent equations decides.
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
"""Arms with fewer joints get a small network and all their samples."""
WIDTH = 16
"""Width of the hidden layer that mass matrix and potential share."""
ROWS_PER_PARAMETER = 14
"""Equations per parameter in a step of Gauss-Newton. For 16 x 16 units, seven did as well."""
MOST_INDEPENDENT = 6
"""Above this number of independent equations per parameter of the small network, a large one by Adam is better."""


class Suited(NamedTuple):
    """Settings of a structured network."""

    optimizer: str
    """gauss-newton or adam."""
    keywords: dict[str, int | bool]
    """Keywords of `make_delan`: width, depth, and whether networks share a trunk."""
    steps: int
    """Steps of the optimiser that take half a minute."""
    samples: int | None
    """Number of samples drawn for the fit; `None` for all."""
    reason: str


def suited_network(needs: Needs, train: Trajectories) -> Suited:
    """Returns the settings for an arm of many joints, from its needs and the information in the training motions."""
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
    """Returns d times the number of effective independent samples, the median over the joints' accelerations.

    It does not change if motions are sampled more often.
    """
    counts = [effective_samples(column - column.mean(), data.trajectory) for column in data.qdd.T]
    return round(data.degrees_of_freedom * float(np.median(counts)))
