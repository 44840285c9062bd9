"""Sampling of a log: rate and gaps, equal steps, repeated rows, and the noise and resolution of every channel.

Noise is estimated from differences of neighbouring samples. Differences of order m of white noise with standard
deviation s have the variance s² C(2m, m), while differences of a slow signal vanish as (2 pi f / rate)^m. Their median
size is insensitive to rare jumps, for example from dry friction when a joint reverses. Any remaining signal increases
an estimate, so the smallest estimate of several orders is used.

A logger that is faster than its source, or that misses a message, writes the last row again. Differences across such a
row are wrong by a whole step, far more than encoder noise. The step after the repeat distinguishes two cases. After a
*lost* row the next one is on time, so the joint has moved twice as far as usual. After an *inserted* row it has moved
the usual distance, because the source is slower than the times of the log suggest.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import GAP, segments, select_samples
from dln_jax.types import InputError, JointSamples, JointVector, SampleIndex, SampleVector

BRIDGED = 3.5
"""Gaps up to this multiple of the median step are interpolated; longer ones cut a trajectory."""
EVEN = 1e-3
"""Samples are resampled if they deviate more from equal steps (relative)."""
DROPPED = ("p", "pd", "tau_inertial", "tau_coriolis", "tau_gravity")
"""Arrays of a log that are dropped by resampling to equal steps."""
ORDERS = (2, 3, 4, 5, 6)
NORMAL = 0.67448975
"""Median absolute value of a standard normal variable."""
SLOW = 5e-3
"""If the estimated noise exceeds this fraction of the positions' standard deviation, sampling is too slow: the
differences are motion."""
TINY = 1e-280
"""Smaller channels count as constant, because they do not have twelve digits."""
LONGEST = 5
"""Longest run of repeated rows; a longer standstill is a joint at rest or a gap in the messages."""
COMPARABLE = 0.3
"""The steps before and after a repeat must be at least this fraction of the step that ends it."""
CLEAR = 3.0
"""A joint must move by this many encoder steps after a repeat, so that resolution does not explain equal readings."""
CHANCE = 3.0
"""Equal rows must exceed the number expected by chance, for independent channels, by this factor."""
NEAR = 5
"""The usual step is computed from this number of steps on either side of a repeat."""
LOST = 1.5
"""A row was lost if the step after a repeat is at least this multiple of the usual step."""


class Timing(NamedTuple):
    """Sampling rate, jitter and gaps of a log."""

    rate: float
    """Hz, from the median over trajectories of their median steps."""
    jitter: float
    """Standard deviation of the steps without gaps, relative to the median step; the largest of all trajectories."""
    gaps: int
    """Number of steps longer than `GAP` times the median."""
    longest: float
    """s, the longest step."""
    rates: Float[np.ndarray, " K"]
    """Hz, for every trajectory with two samples or more."""


class Repeats(NamedTuple):
    """Samples that repeat the previous one while the robot moves."""

    q: Bool[np.ndarray, " N"]
    """All coordinates repeat."""
    tau: Bool[np.ndarray, " N"]
    """All torques repeat."""
    inserted: bool
    """Whether rows were inserted, which makes the times of all later samples too late."""

    @property
    def rows(self) -> Bool[np.ndarray, " N"]:
        """Samples with repeated coordinates and torques."""
        return self.q & self.tau


def timing(t: SampleVector, trajectory: SampleIndex) -> Timing:
    """Computes rate, jitter and gaps.

    Raises:
        InputError: no trajectory has two samples.
    """
    steps = [np.diff(part) for part in by_trajectory(t, trajectory) if len(part) > 1]
    if not steps:
        raise InputError("no trajectory has two samples, so there is no sampling rate; record longer trajectories")
    typical = np.array([np.median(part) for part in steps])
    relative = [part / step for part, step in zip(steps, typical, strict=True)]
    return Timing(
        rate=float(1 / np.median(typical)),
        jitter=float(max(part[part <= GAP].std() for part in relative)),
        gaps=int(sum(np.sum(part > GAP) for part in relative)),
        longest=float(max(part.max() for part in steps)),
        rates=1 / typical,
    )


def typical_rate(data: Trajectories) -> float:
    """Returns the rate by the median step, Hz, without the rounding errors of time differences."""
    return float(f"{timing(data.t, data.trajectory).rate:.9g}")


def even(
    t: Float[np.ndarray, " n"], values: Float[np.ndarray, "n k"], rate: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m k"]]:
    """Resamples one segment to equal steps by a cubic spline; unchanged if it already has them."""
    # The margins keep the last sample if rounding puts it just below a whole step.
    count = int(np.floor((t[-1] - t[0]) * rate * (1 + 1e-9) + 1e-6)) + 1
    uniform = t[0] + np.arange(count) / rate
    if count == len(t) and np.abs(t - uniform).max() * rate < EVEN:
        return uniform, values
    return uniform, spline(t, values)(np.minimum(uniform, t[-1]))


def spline(t: Float[np.ndarray, " n"], values: np.ndarray, degree: int = 3) -> Any:
    """Returns SciPy's spline through values [n, ..], of lower degree if there are too few samples."""
    from scipy.interpolate import make_interp_spline

    return make_interp_spline(t, values, k=min(degree, len(t) - 1))


def held_at_equal_steps(data: Trajectories, rate: float | None = None) -> Trajectories:
    """Resamples q and commanded torques, which are held from each sample to the next, to equal steps.

    tau becomes its mean over the step after each sample, which keeps impulses exact; a spline would overshoot. Long
    gaps remain. Rates become NaN, and other arrays are dropped; `smooth` derives rates from q.

    Args:
        data: q, tau and the times of the samples.
        rate: rate of the equal steps, Hz (default: the median of the data).
    """
    from scipy.interpolate import BSpline

    rate = typical_rate(data) if rate is None else rate
    step = 1 / rate
    rows = []
    for piece in segments(data.t, data.trajectory, gap=BRIDGED):
        t, q, tau = data.t[piece], data.q[piece], data.tau[piece]
        times, positions = even(t, q, rate)
        if positions is not q:
            # Each value holds until the next sample, the last one forever.
            ends = np.append(t, max(t[-1], times[-1]) + 2 * step)
            integral = BSpline(ends, tau, 0).antiderivative()
            tau = (integral(times + step) - integral(times)) / step
        rows.append((times, positions, tau, np.full(len(times), data.trajectory[piece[0]])))
    t, q, tau, trajectory = map(np.concatenate, zip(*rows, strict=True))
    absent = np.full_like(q, np.nan)
    dropped = dict.fromkeys((*DROPPED, "temperature"))
    return data._replace(t=t, q=q, qd=absent, qdd=absent, tau=tau, trajectory=trajectory, **dropped)


def noise_of(values: Float[np.ndarray, "N k"], trajectory: SampleIndex) -> Float[np.ndarray, " k"]:
    """Estimates the standard deviation of each channel's white noise; at least the quantisation noise, step / √12.

    Samples must have equal steps with rare gaps. Trajectories of fewer than seven samples are ignored. Zero for a
    constant channel, infinite if all trajectories are shorter.
    """
    parts = [part for part in by_trajectory(values, trajectory) if len(part) > max(ORDERS)]
    if not parts:
        return np.full(values.shape[1], np.inf)
    smallest = step_of(values) / math.sqrt(12)
    spreads = []
    for order in ORDERS:
        changes = np.concatenate([np.diff(part, n=order, axis=0) for part in parts])
        spreads.append(np.median(abs(changes), axis=0) / (NORMAL * math.sqrt(math.comb(2 * order, order))))
    return np.maximum(np.min(spreads, axis=0), smallest)


def torque_noise(data: Trajectories) -> JointVector | None:
    """Estimates the standard deviation of each torque's white noise, N m or N; `None` if sampling is too slow.

    Positions are measured much more accurately than torques, so their apparent noise shows whether it is.
    """
    spread = data.q.std(axis=0)
    moving = spread > 0
    if not moving.any() or not (noise_of(data.q, data.trajectory)[moving] <= SLOW * spread[moving]).all():
        return None
    return noise_of(data.tau, data.trajectory)


def step_of(values: Float[np.ndarray, "N k"]) -> Float[np.ndarray, " k"]:
    """Returns the step size of every channel, such as an encoder's resolution; zero for a channel without levels."""
    return np.array([_step(channel) for channel in values.T])


def by_trajectory(values: np.ndarray, trajectory: np.ndarray) -> list[np.ndarray]:
    """Splits values by trajectory."""
    return np.split(values, np.flatnonzero(np.diff(trajectory)) + 1)


def _step(channel: np.ndarray) -> float:
    size = np.abs(channel).max(initial=0.0)
    if size < TINY:
        return 0.0
    # Twelve significant digits, so that rounding errors do not split a level.
    levels = np.unique(np.round(channel, 12 - int(np.ceil(np.log10(size)))))
    if len(levels) < 3:
        return 0.0
    distances = np.diff(levels)
    smallest = float(distances.min())
    multiples = distances / smallest
    # Rounding in the log moves levels slightly.
    return smallest if np.mean(np.abs(multiples - np.round(multiples)) < 0.05) > 0.99 else 0.0


def delay_held(values: Float[np.ndarray, "N k"], samples: float) -> Float[np.ndarray, "N k"]:
    """Delays held values by a number of samples; returns their mean over the step after each sample.

    Values before the first sample are zero.

    Args:
        samples: delay in samples, not necessarily whole.

    Raises:
        InputError: the delay is negative or not finite.
    """
    if not 0 <= samples < np.inf:
        raise InputError(f"delay is {samples}; expected a number of samples, 0 or more")
    whole = int(samples)
    share = samples - whole
    held = np.pad(values, ((whole + 1, 0), (0, 0)))[: len(values) + 1]
    return (1 - share) * held[1:] + share * held[:-1]


def find_repeats(q: JointSamples, tau: JointSamples, trajectory: SampleIndex) -> Repeats:
    """Finds repeated samples of q and of tau; torques that never vary repeat with q."""
    of_q, after = _repeating(q, trajectory)
    of_tau, _ = _repeating(tau, trajectory)
    # Constant torques are common, so a repeated row requires repeated coordinates.
    of_tau |= of_q & np.r_[False, (np.diff(tau, axis=0) == 0).all(axis=1)]
    return Repeats(of_q, of_tau, after < LOST and not (of_q & ~of_tau).any())


def without_repeats(data: Trajectories) -> tuple[Trajectories, Repeats]:
    """Removes repeated rows from a log; returns the log and the repeats.

    If the rows were inserted, their time is removed too and the other steps are stretched to the same total. If only q
    or only tau repeats, it is interpolated.
    """
    repeats = find_repeats(data.q, data.tau, data.trajectory)
    if not (repeats.q | repeats.tau).any():
        return data, repeats
    t, trajectory = data.t, data.trajectory
    q = interpolate(t, data.q, trajectory, repeats.q & ~repeats.rows)
    tau = interpolate(t, data.tau, trajectory, repeats.tau & ~repeats.rows)
    if repeats.inserted:
        t = _source_times(t, trajectory, repeats.rows)
    return select_samples(data._replace(t=t, q=q, tau=tau), ~repeats.rows), repeats


def _repeating(values: np.ndarray, trajectory: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns a mask of repeated rows, and the step after a repeat relative to the usual step (infinite if none)."""
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
        later = np.searchsorted(moves, last + 1)
        if first == 0 or later == len(moves) or last - first > LONGEST:
            continue
        after = moves[later]
        if after - first >= 3 * LONGEST or not inside[first - 1 : after + 1].all():
            continue
        usual, ending, following = changes[first - 1], changes[last], changes[after]
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


def interpolate(t: np.ndarray, values: np.ndarray, trajectory: np.ndarray, wrong: np.ndarray) -> np.ndarray:
    """Replaces wrong samples by a cubic spline through the others of the trajectory."""
    if not wrong.any():
        return values
    values = values.copy()
    for index in np.unique(trajectory[wrong]):
        here = np.flatnonzero(trajectory == index)
        good, bad = here[~wrong[here]], here[wrong[here]]
        values[bad] = spline(t[good], values[good])(t[bad])
    return values


def _source_times(t: np.ndarray, trajectory: np.ndarray, repeated: np.ndarray) -> np.ndarray:
    """Returns times on the source's clock: a repeat takes no time, and each trajectory keeps its duration."""
    t = t.copy()
    for index in np.unique(trajectory[repeated]):
        here = np.flatnonzero(trajectory == index)
        steps = np.where(repeated[here], 0.0, np.r_[0.0, np.diff(t[here])])
        last = here[~repeated[here]][-1]
        t[here] = t[here[0]] + np.cumsum(steps) * (t[last] - t[here[0]]) / steps.sum()
    return t
