"""Letters as motions that an arm is to follow at the rate of its controller, at any speed."""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from dln_jax.control import Reference
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select

RATE = 1000.0
"""Hz, of the controller."""
RECORDED = 25.0
"""Hz, of the samples that are learned from, times the speed."""


class Motion(NamedTuple):
    """A letter as the controller is given it."""

    label: str
    reference: Reference
    """At the controller's rate; the arm stands still behind the letter, so that all letters have one length."""
    samples: int
    """Of the letter itself."""


def drawn_letters(data: Trajectories, count: int, seed: int, speed: float) -> list[Motion]:
    """Different letters in an order that the seed draws."""
    letters = np.unique(data.trajectory).tolist()
    longest = max(len(reference(select(data, [index]), speed).q) for index in letters)
    order = np.random.default_rng([seed, 2]).permutation(letters)[:count].tolist()
    found = []
    for index in order:
        q, qd, qdd = reference(select(data, [index]), speed)
        more = ((0, longest - len(q)), (0, 0))
        padded = Reference(np.pad(q, more, mode="edge"), np.pad(qd, more), np.pad(qdd, more))
        found.append(Motion(str(data.label[index]), padded, len(q)))
    return found


def reference(letter: Trajectories, speed: float = 1.0) -> Reference:
    """A cubic spline through the angles of a letter, and its derivatives, at the controller's rate."""
    seconds = letter.t - letter.t[0]
    spline = CubicSpline(seconds, letter.q)
    t = speed * np.arange(int(seconds[-1] / speed * RATE) + 1) / RATE
    return Reference(spline(t), speed * spline(t, 1), speed**2 * spline(t, 2))


def capacity(data: Trajectories, letters: int) -> int:
    """Places for the recordings of any so many letters: one program for all conditions and seeds."""
    starts = np.flatnonzero(np.diff(data.trajectory, prepend=-1))
    seconds = np.maximum.reduceat(data.t, starts) - np.minimum.reduceat(data.t, starts)
    return int(np.sort(np.ceil(RECORDED * seconds) + 1)[-letters:].sum())
