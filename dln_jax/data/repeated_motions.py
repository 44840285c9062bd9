"""Motions that several recordings show: a robot that runs one trajectory twenty times gives twenty similar recordings.

A model that was trained on some of them predicts the others about as well as the robot repeats itself, which says
little about any other motion. Splits therefore keep recordings of one motion together.

Positions at `TIMES` times, a delay embedding (Takens 1981), describe where a robot is and how it moves, without the
noise of measured velocities. A recording repeats another if nine tenths of its embedded positions lie near the
other's, at whatever time: it may start later, or show a part of the motion.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from dln_jax.data.schema import Trajectories

TIMES, DURATION = 5, 0.3
"""Number of embedded times, and the time that they span as a share of the shortest recording."""
CLOSE, SHARE = 0.1, 0.9
"""Largest root mean square distance, in units of the positions' standard deviations, and the share of a recording that
lies within it. A real arm of six joints repeated motions within 0.03 to 0.15; the nearest of twenty letters are 0.3
apart."""
POINTS = 50
"""Number of positions of a recording that are compared with the others."""
SHORTEST, MOST = 50, 300
"""Fewest samples of a recording that is compared, and the largest number of recordings."""


def motion_numbers(q: Float[np.ndarray, "N d"], trajectory: Int[np.ndarray, " N"]) -> Int[np.ndarray, " T"]:
    """Returns the number of the motion that each trajectory shows, by the trajectory's index.

    Motions are numbered by their first trajectories; absent trajectories have -1. Motionless, short, or very many
    trajectories, and those of one coordinate, count as motions of their own: with a single coordinate, different
    motions pass the same states.
    """
    present, inverse = np.unique(trajectory, return_inverse=True)
    rows = np.split(np.argsort(inverse, kind="stable"), np.cumsum(np.bincount(inverse))[:-1])
    number = np.arange(len(present))
    moving = [k for k, own in enumerate(rows) if len(own) >= SHORTEST and np.ptp(q[own], axis=0).any()]
    if q.shape[1] > 1 and 1 < len(moving) <= MOST:
        step = int(DURATION * min(len(rows[k]) for k in moving) / (TIMES - 1))
        spread = q.std(axis=0)
        scaled = q[:, spread > 0] / spread[spread > 0] / np.sqrt(TIMES * np.sum(spread > 0))
        embedded = [_embedded(scaled[rows[k]], step) for k in moving]
        some = np.concatenate([own[np.linspace(0, len(own) - 1, POINTS).astype(int)] for own in embedded])
        for own in embedded:
            distances = cKDTree(own).query(some, distance_upper_bound=CLOSE)[0].reshape(-1, POINTS)
            joined = number[moving][np.mean(distances <= CLOSE, axis=1) >= SHARE]
            number[np.isin(number, joined)] = joined.min()
    numbers = np.full(present.max() + 1, -1)
    numbers[present] = np.unique(number, return_inverse=True)[1]
    return numbers


def remark_on_repeats(trained: Sequence[Trajectories], test: Trajectories) -> str:
    """Returns a line on recordings of one motion: they stay together, or the test repeats trained ones."""
    sets = [*trained, test]
    motion = motion_numbers(np.concatenate([part.q for part in sets]), np.concatenate([s.trajectory for s in sets]))
    seen, held = np.unique(np.concatenate([part.trajectory for part in trained])), np.unique(test.trajectory)
    repeating = held[np.isin(motion[held], motion[seen])]
    if len(repeating):
        twin = seen[motion[seen] == motion[repeating[0]]][0]
        return (
            f"warning: {len(repeating)} of {len(held)} held-out motions repeat trained ones, such as "
            f"'{test.label[repeating[0]]}' and '{test.label[twin]}'; errors on other motions may be larger: hold out "
            "other motions by --test, or record more"
        )
    recordings, different = len(seen) + len(held), len(np.unique(motion[np.concatenate([seen, held])]))
    if different == recordings:
        return ""
    return f"{recordings} recordings show {different} motions; recordings of one motion stay together in the split"


def _embedded(q: np.ndarray, step: int) -> np.ndarray:
    count = len(q) - (TIMES - 1) * step
    return np.hstack([q[k * step : k * step + count] for k in range(TIMES)])
