"""Finds repeated rows of a log and removes them.

A logger that is faster than its source, or that misses a message, writes the last row again. Differences across such a
row are wrong by a whole step, far more than encoder noise. The step after the repeat tells two cases apart. After a
*lost* row the next one is on time, so the joint has moved twice as far as usual. After an *inserted* row it has moved
the usual distance, because the source is slower than the log's times claim.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dln_jax.data.encoders.sampling import noise_of, step_of
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select_samples

LONGEST = 5
"""Longest run of rows that counts as repeats; a longer standstill is a joint at rest or a gap in the messages."""
COMPARABLE = 0.3
"""The steps before and after a repeat must be at least this fraction of the step that ends it."""
CLEAR = 3.0
"""A joint must move on by so many encoder steps that resolution cannot explain equal readings."""
CHANCE = 3.0
"""Equal rows must exceed the number expected by chance, for independent channels, by this factor."""
NEAR = 5
"""The usual step is computed from this number of steps on either side of a repeat."""
LOST = 1.5
"""If the step after a repeat is at least this multiple of the usual one, a row was lost."""


class Repeats(NamedTuple):
    """Samples that repeat the one before while the robot moves."""

    q: Bool[np.ndarray, " N"]
    """All coordinates repeat."""
    tau: Bool[np.ndarray, " N"]
    """All torques repeat."""
    inserted: bool
    """Whether rows were inserted, so that the times of all later samples are too late."""

    @property
    def rows(self) -> Bool[np.ndarray, " N"]:
        """Samples whose coordinates and torques both repeat."""
        return self.q & self.tau


def find_repeats(
    q: Float[np.ndarray, "N d"], tau: Float[np.ndarray, "N d"], trajectory: Int[np.ndarray, " N"]
) -> Repeats:
    """Finds repeated samples of q and of tau; torques that never vary count as repeating with q."""
    of_q, after = _repeating(q, trajectory)
    if not np.ptp(tau, axis=0).any():
        return Repeats(of_q, of_q, after < LOST)
    of_tau, _ = _repeating(tau, trajectory)
    # A torque may be constant by itself, so a repeated row requires repeated coordinates.
    same = np.r_[False, (np.diff(tau, axis=0) == 0).all(axis=1)]
    of_tau = of_tau | (of_q & same)
    both = of_q & of_tau
    return Repeats(of_q, of_tau, bool(both.any() and np.array_equal(of_q, both)) and after < LOST)


def without_repeats(data: Trajectories) -> tuple[Trajectories, Repeats]:
    """The log without its repeats, and the repeats.

    Repeated rows are removed. If they were inserted, their time is removed too and the remaining steps are stretched to
    the same total. If q or tau repeat alone, they are interpolated.
    """
    repeats = find_repeats(data.q, data.tau, data.trajectory)
    if not (repeats.q.any() or repeats.tau.any()):
        return data, repeats
    t, trajectory = data.t, data.trajectory
    q = interpolated(t, data.q, trajectory, repeats.q & ~repeats.rows)
    tau = interpolated(t, data.tau, trajectory, repeats.tau & ~repeats.rows)
    if repeats.inserted:
        t = _source_times(t, trajectory, repeats.rows)
    return select_samples(data._replace(t=t, q=q, tau=tau), ~repeats.rows), repeats


def _repeating(values: np.ndarray, trajectory: np.ndarray) -> tuple[np.ndarray, float]:
    """Mask of the rows that repeat the one before, and the size of the step after a repeat in usual steps."""
    repeating = np.zeros(len(values), bool)
    changes = np.diff(values, axis=0)
    inside = np.diff(trajectory) == 0
    same = (changes == 0).all(axis=1) & inside
    # Channels with few levels are sometimes equal, and all of them at once by chance.
    others = changes[inside & ~same] == 0
    by_chance = float(np.prod(others.mean(axis=0))) * len(changes) if len(others) else np.inf
    if same.sum() <= CHANCE * by_chance:
        return repeating, np.inf
    levels, noise = step_of(values), noise_of(values, trajectory)
    moves = np.flatnonzero(~same)
    along, usual_squared = 0.0, 0.0
    for first, last in np.flatnonzero(np.diff(np.r_[0, same.astype(int), 0])).reshape(-1, 2):
        # Samples first + 1 to last repeat sample first; the changes before and after may end other repeats.
        place = int(np.searchsorted(moves, first))
        if not 0 < place < len(moves) - 1 or last - first > LONGEST:
            continue
        before, after = moves[place - 1], moves[place + 1]
        if after - before > 3 * LONGEST or not inside[before : after + 1].all():
            continue
        usual, ending, following = changes[before], changes[last], changes[after]
        smaller = np.minimum(usual * np.sign(ending), following * np.sign(ending))
        moving = (np.abs(ending) > CLEAR * levels) & (smaller > COMPARABLE * np.abs(ending) / (last - first + 1))
        # Noise without levels never repeats exactly.
        noisy = (levels == 0) & (noise > 0.1 * np.abs(usual)) & (noise < np.inf)
        if not (moving | noisy).any():
            continue
        repeating[first + 1 : last + 1] = True
        around = changes[max(first - NEAR, 0) : first], changes[last + 1 : last + 1 + NEAR]
        typical = np.mean(np.concatenate(around), axis=0)
        along, usual_squared = along + float(ending @ typical), usual_squared + float(typical @ typical)
    return repeating, along / usual_squared if usual_squared > 0 else np.inf


def interpolated(t: np.ndarray, values: np.ndarray, trajectory: np.ndarray, wrong: np.ndarray) -> np.ndarray:
    """Replaces the wrong samples by a cubic spline through the others of their trajectory."""
    if not wrong.any():
        return values
    from scipy.interpolate import make_interp_spline

    values = values.copy()
    for index in np.unique(trajectory[wrong]):
        here = np.flatnonzero(trajectory == index)
        good, bad = here[~wrong[here]], here[wrong[here]]
        values[bad] = make_interp_spline(t[good], values[good], k=min(3, len(good) - 1), axis=0)(t[bad])
    return values


def _source_times(t: np.ndarray, trajectory: np.ndarray, repeated: np.ndarray) -> np.ndarray:
    """Times of the rows on the source's clock: a repeat takes no time, and each trajectory keeps its duration."""
    t = t.copy()
    for index in np.unique(trajectory[repeated]):
        here = np.flatnonzero(trajectory == index)
        steps = np.where(repeated[here], 0.0, np.r_[0.0, np.diff(t[here])])
        last = here[~repeated[here]][-1]
        t[here] = t[here[0]] + np.cumsum(steps) * (t[last] - t[here[0]]) / steps.sum()
    return t
