"""Recognises recordings of the same motion, such as a robot running one trajectory twenty times.

A model trained on some of them predicts the others about as well as the robot repeats itself, which says little about
other motions. Splits therefore keep recordings of one motion together.

Positions at `TIMES` times, a delay embedding (Takens 1981), describe where a robot is and how it moves, without the
noise of measured velocities. A recording repeats another if nine tenths of its embedded positions lie near positions of
the other at any time: it may start later, or show a part of the motion.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int
from scipy.spatial import KDTree

from dln_jax.data.schema import Trajectories
from dln_jax.types import JointSamples, SampleIndex

TIMES, DURATION = 5, 0.3
"""Number of embedded times, and their span as a fraction of the shortest recording."""
CLOSE, SHARE = 0.1, 0.9
"""Largest root mean square distance in standard deviations of the positions, and the fraction of a recording within it.
A real arm of six joints repeated motions within 0.03 to 0.15; the nearest of twenty letters are 0.3 apart."""
POINTS = 50
"""Number of positions of a recording for the comparison."""
MOVING = 1.0
"""Recordings that move less than this multiple of `CLOSE` can join a motion but cannot connect two."""
SHORTEST, MOST = 50, 300
"""Fewest samples of a recording for the comparison, and the largest number of recordings."""


def motion_numbers(q: JointSamples, trajectory: SampleIndex) -> Int[np.ndarray, " T"]:
    """Returns the motion number of each trajectory, by the trajectory's index.

    The first trajectory of a motion gives its number; absent trajectories have -1. Motionless trajectories, short
    trajectories, very many of them, and trajectories of one coordinate count as separate motions: with a single
    coordinate, different motions pass the same states.
    """
    present = np.unique(trajectory)
    number = np.arange(present.max() + 1)
    embedded = _embedded(q, trajectory)
    if embedded:
        compared = np.array(list(embedded))
        some = np.concatenate([_some(own) for own in embedded.values()])
        moving = np.array([np.linalg.norm(own.std(axis=0)) >= MOVING for own in embedded.values()])
        free = ~moving
        for k in np.flatnonzero(moving):
            near = _near(embedded[compared[k]], some).reshape(-1, POINTS).mean(axis=1) >= SHARE
            joined = number[compared[near & moving]]
            number[np.isin(number, joined) | np.isin(np.arange(len(number)), compared[near & free])] = joined.min()
            free &= ~near
    numbers = np.full(len(number), -1)
    numbers[present] = np.unique(number[present], return_inverse=True)[1]
    return numbers


def remark_on_repeats(
    trained: Sequence[Trajectories], test: Trajectories, motion: Int[np.ndarray, " T"] | None = None
) -> str:
    """Returns a line on repeated motions: the test repeats training motions, or `motion` kept them together."""
    sets = [*trained, test]
    q, trajectory = (np.concatenate([getattr(part, key) for part in sets]) for key in ("q", "trajectory"))
    seen, held = np.unique(np.concatenate([part.trajectory for part in trained])), np.unique(test.trajectory)
    embedded = _embedded(q, trajectory)
    twins = {}
    for index in [index for index in held.tolist() if index in embedded]:
        near = {k: _near(embedded[k], _some(embedded[index])) for k in seen.tolist() if k in embedded}
        if near and np.any(list(near.values()), axis=0).mean() >= SHARE:
            twins[index] = max(near, key=lambda k: near[k].sum())
    if twins:
        first = min(twins)
        return (
            f"warning: {len(twins)} of {len(held)} held-out motions repeat trained ones, such as "
            f"'{test.label[first]}' and '{test.label[twins[first]]}'; errors on other motions may be larger: hold out "
            "other motions by --test, or record more"
        )
    present = np.concatenate([seen, held])
    if motion is None or (different := len(np.unique(motion[present]))) == len(present):
        return ""
    return f"{len(present)} recordings show {different} motions; recordings of one motion stay together in the split"


def _embedded(q: np.ndarray, trajectory: np.ndarray) -> dict[int, np.ndarray]:
    """Returns the embedded positions by trajectory index, in units of `CLOSE`."""
    spread = q.std(axis=0)
    if q.shape[1] < 2 or not spread.any():
        return {}
    scaled = q[:, spread > 0] / spread[spread > 0] / np.sqrt(np.sum(spread > 0))
    order = np.argsort(trajectory, kind="stable")
    present, first = np.unique(trajectory[order], return_index=True)
    parts = zip(present.tolist(), np.split(scaled[order], first[1:]), strict=True)
    long = {k: x for k, x in parts if len(x) >= SHORTEST and np.ptp(x, axis=0).any()}
    if not 1 < len(long) <= MOST:
        return {}
    step = int(DURATION * min(map(len, long.values())) / (TIMES - 1))
    size, span = CLOSE * np.sqrt(TIMES), (TIMES - 1) * step
    return {
        k: np.hstack([x[j * step : len(x) - span + j * step] for j in range(TIMES)]) / size for k, x in long.items()
    }


def _some(points: np.ndarray) -> np.ndarray:
    return points[np.linspace(0, len(points) - 1, POINTS).astype(int)]


def _near(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return KDTree(points).query(others, distance_upper_bound=1.0)[0] <= 1.0
