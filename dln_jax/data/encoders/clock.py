"""Recovers the times of regular samples that were stamped on arrival.

A program that reads a robot over a network stamps each row late, by a varying time. Measured positions and velocities
give the true time between two rows:

    step = sum_j w_j dq_j v_j / sum_j w_j v_j²,    v the mean of both rows' qd,    1 / w_j = mean of qd_j²

If these steps are whole multiples of one period and the stamps are not, rows are moved to the multiples, and
interpolated where the robot hardly moves. The mean lateness of the stamps remains.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from dln_jax.data.schema import Trajectories
from dln_jax.types import SampleVector

JITTER = 0.05
"""Stamps are repaired if the standard deviation of their steps exceeds this fraction of a period."""
REGULAR, SHARE = 0.1, 0.98
"""Largest deviation of a step from a whole number of periods, and the fraction of steps that must meet it."""
BETTER = 0.3
"""The computed steps must scatter about whole numbers by less than this fraction of the scatter of the stamps."""
MOVING = 0.3
"""Steps are computed where the joints move faster than this multiple of their root mean square speed."""
LEAST = 100
"""Fewest steps from which a period is estimated."""
SAME = 0.02
"""Largest relative difference of the total durations by steps and by stamps; a larger one suggests wrong units."""
NEAR = 100
"""Rows on either side of a gap between counted steps for comparing the lateness."""
LATE = 0.1
"""s: largest correction of a stamp."""

Counts = tuple[np.ndarray, np.ndarray]
"""Indices of rows, and the number of periods from the first row to each."""


class Clock(NamedTuple):
    """Times of N rows on their source's clock."""

    t: SampleVector
    period: float
    """s."""
    jitter: float
    """Standard deviation of the stamps' steps about whole numbers of periods, in periods."""

    @property
    def line(self) -> str:
        """Jitter of the stamps and steps of the source, in words."""
        return (
            f"t jitters by {self.jitter:.0%} of a step, but q and qd show that rows are whole multiples of "
            f"{1e3 * self.period:.4g} ms apart"
        )


def source_clock(data: Trajectories, interpolated: Bool[np.ndarray, " N"] | None = None) -> Clock | None:
    """Returns the times on the source's clock; `None` if stamps are regular or the motions do not determine the times.

    Args:
        data: rows without repeats, with measured qd.
        interpolated: rows with interpolated instead of measured q.
    """
    known = np.arange(len(data.t)) if interpolated is None else np.flatnonzero(~interpolated)
    if "qd" in data.estimated or len(known) <= LEAST:
        return None
    t, trajectory = data.t[known], data.trajectory[known]
    if (periods := _count_periods(t, data.q[known], data.qd[known], np.diff(trajectory) == 0)) is None:
        return None
    whole, jitter = periods
    runs = np.flatnonzero(np.diff(np.r_[0, (whole > 0).astype(int), 0])).reshape(-1, 2)
    parts = [(np.arange(first, last + 1), np.r_[0.0, np.cumsum(whole[first:last])]) for first, last in runs]
    joined = _on_one_grid(t, trajectory, parts, _common_slope(t, parts))
    period = _common_slope(t, joined.values())
    corrected = data.t.copy()
    for index, (rows, grid) in joined.items():
        times = t[rows].mean() + period * (grid - grid.mean())
        measured = known[rows]
        own = np.flatnonzero(data.trajectory == index)
        stamps = data.t[own]
        # Equal steps between counted rows; stamps, shifted, before the first and after the last.
        even = np.interp(own, measured, times)
        inside = np.clip(stamps, *data.t[measured[[0, -1]]])
        corrected[own] = np.where(stamps == inside, even, stamps + even - inside)
    return Clock(corrected, period, jitter) if np.abs(corrected - data.t).max() <= LATE else None


def _count_periods(t: np.ndarray, q: np.ndarray, qd: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Returns the periods of each step, 0 where they cannot be counted, and the jitter of the stamps in periods.

    `inside` marks the steps [N - 1] within a trajectory. `None` if the steps are not whole numbers of periods, or not
    clearly more regular than the stamps.
    """
    size = np.mean(qd**2, axis=0)
    weights = 1 / np.where(size > 0, size, np.inf)
    v = (qd[1:] + qd[:-1]) / 2
    speed = v**2 @ weights
    moving = inside & (speed > MOVING**2 * np.sum(weights > 0))
    if moving.sum() < LEAST:
        return None
    stamped = np.diff(t)[moving]
    steps = ((np.diff(q, axis=0) * v) @ weights)[moving] / speed[moving]
    period = float(np.median(steps))
    if not period > 0:
        return None
    whole = np.round(steps / period)
    period = float(steps.sum() / max(whole.sum(), 1.0))
    off, off_stamps = (np.abs(of / period - whole) for of in (steps, stamped))
    regular = np.mean((off <= REGULAR) & (whole >= 1)) >= SHARE
    same = abs(period * whole.sum() / stamped.sum() - 1) <= SAME
    jitter = float(np.sqrt(np.mean(off_stamps**2)))
    if not (regular and same and jitter >= JITTER and np.median(off) <= BETTER * np.median(off_stamps)):
        return None
    counts = np.zeros(len(moving))
    counts[moving] = np.maximum(whole, 0.0)
    return counts, jitter


def _common_slope(t: np.ndarray, parts: Iterable[Counts]) -> float:
    """Returns the period on the clock of the stamps: their common slope over the counts, by least squares."""
    centred = [(counts - counts.mean(), t[rows] - t[rows].mean()) for rows, counts in parts]
    return float(sum(counts @ stamps for counts, stamps in centred) / sum(counts @ counts for counts, _ in centred))


def _on_one_grid(t: np.ndarray, trajectory: np.ndarray, parts: list[Counts], period: float) -> dict[int, Counts]:
    """Returns one part per trajectory, with all counts from one start.

    The number of periods between two runs makes the mean lateness of neighbouring rows agree. The period alone is not
    accurate enough over many rows.
    """
    joined: dict[int, Counts] = {}
    for rows, counts in parts:
        index = int(trajectory[rows[0]])
        if index in joined:
            before, grid = joined[index]
            late = np.mean(t[before[-NEAR:]] / period - grid[-NEAR:])
            shift = np.round(np.mean(t[rows[:NEAR]] / period - counts[:NEAR]) - late)
            counts = np.append(grid, max(shift, grid[-1] + 1) + counts)
            rows = np.append(before, rows)
        joined[index] = rows, counts
    return joined
