"""Rows that a log repeats, and the log without them.

A logger that is faster than its source, or that misses a message, writes the last row once more. Differences across
such a row are wrong by a whole step, which noise of an encoder never is. Two cases are told apart by the step that
follows: after a *lost* row the next one is on time, so the joint has moved twice as far as usual; after an *inserted*
row it has moved as far as always, because the source is slower than the times in the log claim.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dln_jax.data.encoders.noise import noise_of, step_of
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select_samples

LONGEST = 5
"""Rows in a row that count as repeats; a longer standstill is a joint at rest or a gap in the messages."""
COMPARABLE = 0.3
"""The steps before and after a repeat must be at least this fraction of the step that ends it."""
CLEAR = 3.0
"""Steps of the encoder by which a joint must move on, so that equal readings are no matter of resolution."""
CHANCE = 3.0
"""Times as many rows have to be equal as would be by chance, were the channels independent."""
NEAR = 5
"""Steps on either side of a repeat that say how far a joint usually moves in one."""
LOST = 1.5
"""Times the usual step, from which on the step after a repeat says that a row was lost."""


class Repeats(NamedTuple):
    """Samples that repeat the one before while the robot moves."""

    q: Bool[np.ndarray, " N"]
    """All coordinates repeat."""
    tau: Bool[np.ndarray, " N"]
    """All torques repeat."""
    inserted: bool
    """Whether the rows were inserted, so that all later samples carry times that are too late."""

    @property
    def rows(self) -> Bool[np.ndarray, " N"]:
        """Coordinates and torques repeat together."""
        return self.q & self.tau


def find_repeats(
    q: Float[np.ndarray, "N d"], tau: Float[np.ndarray, "N d"], trajectory: Int[np.ndarray, " N"]
) -> Repeats:
    """Finds repeated samples of q and of tau; torques that never vary repeat with q."""
    of_q, after = _repeating(q, trajectory)
    if not np.ptp(tau, axis=0).any():
        return Repeats(of_q, of_q, after < LOST)
    of_tau, _ = _repeating(tau, trajectory)
    # A torque may stand still by itself, so a whole row needs coordinates that repeat.
    same = np.r_[False, (np.diff(tau, axis=0) == 0).all(axis=1)]
    of_tau = of_tau | (of_q & same)
    both = of_q & of_tau
    return Repeats(of_q, of_tau, bool(both.any() and np.array_equal(of_q, both)) and after < LOST)


def without_repeats(data: Trajectories) -> tuple[Trajectories, Repeats]:
    """The log without its repeats, and which they were.

    Whole rows that repeat are left out; rows that were inserted also give their time back: the steps between the
    others are stretched to the same total. Where q or tau repeat alone they are interpolated.
    """
    repeats = find_repeats(data.q, data.tau, data.trajectory)
    if not (repeats.q.any() or repeats.tau.any()):
        return data, repeats
    t, trajectory = data.t, data.trajectory
    q = _interpolated(t, data.q, trajectory, repeats.q & ~repeats.rows)
    tau = _interpolated(t, data.tau, trajectory, repeats.tau & ~repeats.rows)
    if repeats.inserted:
        t = _source_times(t, trajectory, repeats.rows)
    return select_samples(data._replace(t=t, q=q, tau=tau), ~repeats.rows), repeats


def _repeating(values: np.ndarray, trajectory: np.ndarray) -> tuple[np.ndarray, float]:
    """Which rows repeat the one before, and how far the values move after a repeat, in usual steps."""
    found = np.zeros(len(values), bool)
    changes = np.diff(values, axis=0)
    inside = np.diff(trajectory) == 0
    same = (changes == 0).all(axis=1) & inside
    # Channels with few levels are equal now and then, and all of them by chance.
    others = changes[inside & ~same] == 0
    by_chance = float(np.prod(others.mean(axis=0))) * len(changes) if len(others) else np.inf
    if same.sum() <= CHANCE * by_chance:
        return found, np.inf
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
        # Noise without levels is never twice the same.
        noisy = (levels == 0) & (noise > 0.1 * np.abs(usual)) & (noise < np.inf)
        if not (moving | noisy).any():
            continue
        found[first + 1 : last + 1] = True
        around = changes[max(first - NEAR, 0) : first], changes[last + 1 : last + 1 + NEAR]
        typical = np.mean(np.concatenate(around), axis=0)
        along, usual_squared = along + float(ending @ typical), usual_squared + float(typical @ typical)
    return found, along / usual_squared if usual_squared > 0 else np.inf


def _interpolated(t: np.ndarray, values: np.ndarray, trajectory: np.ndarray, wrong: np.ndarray) -> np.ndarray:
    """Values with the wrong samples replaced by a cubic spline through the others of their trajectory."""
    if not wrong.any():
        return values
    from scipy.interpolate import make_interp_spline

    values = values.copy()
    for each in np.unique(trajectory[wrong]):
        here = np.flatnonzero(trajectory == each)
        good, bad = here[~wrong[here]], here[wrong[here]]
        values[bad] = make_interp_spline(t[good], values[good], k=min(3, len(good) - 1), axis=0)(t[bad])
    return values


def _source_times(t: np.ndarray, trajectory: np.ndarray, repeated: np.ndarray) -> np.ndarray:
    """Times of the rows by their source's clock: a repeat takes none, and each trajectory lasts as long as before."""
    t = t.copy()
    for each in np.unique(trajectory[repeated]):
        here = np.flatnonzero(trajectory == each)
        steps = np.where(repeated[here], 0.0, np.r_[0.0, np.diff(t[here])])
        last = here[~repeated[here]][-1]
        t[here] = t[here[0]] + np.cumsum(steps) * (t[last] - t[here[0]]) / steps.sum()
    return t
