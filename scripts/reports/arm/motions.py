"""Letters as reference motions at the controller's rate, at any speed."""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from dln_jax.control import Reference
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select

RATE = 1000.0
"""Rate of the controller, Hz."""
RECORDED = 25.0
"""Rate of the training samples at normal speed, Hz; it is multiplied by the speed."""


class Motion(NamedTuple):
    """A letter as a reference for the controller."""

    label: str
    reference: Reference
    """Reference at the controller's rate, padded with rest so that all letters have the same length."""
    samples: int
    """Number of samples of the letter without padding."""


def drawn_letters(data: Trajectories, count: int, seed: int, speed: float) -> list[Motion]:
    """Distinct letters in a random order set by the seed."""
    letters = np.unique(data.trajectory).tolist()
    longest = max(len(reference(select(data, [index]), speed).q) for index in letters)
    order = np.random.default_rng([seed, 2]).permutation(letters)[:count].tolist()
    motions = []
    for index in order:
        q, qd, qdd = reference(select(data, [index]), speed)
        more = ((0, longest - len(q)), (0, 0))
        padded = Reference(np.pad(q, more, mode="edge"), np.pad(qd, more), np.pad(qdd, more))
        motions.append(Motion(str(data.label[index]), padded, len(q)))
    return motions


def reference(letter: Trajectories, speed: float = 1.0) -> Reference:
    """A cubic spline through the angles of a letter with its derivatives, at the controller's rate."""
    seconds = letter.t - letter.t[0]
    spline = CubicSpline(seconds, letter.q)
    t = speed * np.arange(int(seconds[-1] / speed * RATE) + 1) / RATE
    return Reference(spline(t), speed * spline(t, 1), speed**2 * spline(t, 2))


def capacity(data: Trajectories, letters: int) -> int:
    """Samples that the longest `letters` letters need, so that one compiled program fits all conditions and seeds."""
    starts = np.flatnonzero(np.diff(data.trajectory, prepend=-1))
    seconds = np.maximum.reduceat(data.t, starts) - np.minimum.reduceat(data.t, starts)
    return int(np.sort(np.ceil(RECORDED * seconds) + 1)[-letters:].sum())
