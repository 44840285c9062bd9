"""Converts q, t and tau of a log to trajectories with derivatives.

1. Repeated rows are removed (see `sampling`). The source's times replace stamps of arrival (see `clock`), the only use
   of measured rates. Long gaps cut a trajectory into parts named LABEL/1, LABEL/2 and so on; short ones are bridged.
   Samples at unequal steps are interpolated to one rate.
2. The noise of every channel is estimated. The noise and the spectra of q determine the cut-off, unless it is set.
3. q is filtered without delay; qd and qdd are derivatives of the result. tau is filtered too if samples are dropped,
   or on request.
4. The ends, where a filter sees one side only, are trimmed, and every k-th sample is kept.

Torques are not filtered by default. Least squares average out their noise, and filtered dry friction does not match any
state (see `filters`). On a simulated seven-axis arm, filtering them increased the error by a factor of 1.6
(`scripts.reports.robots.known_kinematics`).

`smooth_locally` is for short or unevenly sampled motions. It fits a polynomial in time by least squares to the
neighbours of every sample, at any spacing (Savitzky and Golay 1964). The leave-one-out error e_i / (1 - H_ii) (Allen
1974) chooses the number of neighbours per coordinate: few for a strongly curved motion, many for a noisy one. This
assumes independent noise.

The low-pass filter of `smooth` is for long logs: it needs equal steps and four periods of its cut-off, and is less
accurate near the ends. On eight segments of 61 samples its velocities had two to five times the error of local
polynomials, and its noise estimate was a quarter too small if steps varied by 30 %.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dln_jax.data.arrays import spread
from dln_jax.data.encoders import sampling
from dln_jax.data.encoders.clock import Clock, source_clock
from dln_jax.data.encoders.filters import Choice, choose_cutoff, derivatives, low_pass
from dln_jax.data.encoders.sampling import Repeats, interpolate, noise_of, without_repeats
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import segments, select_samples
from dln_jax.types import InputError, JointVector, require_positive

SHORT = 0.01
"""s: gaps up to this length are bridged at any rate; the error of a cubic spline through motions of 10 Hz is at most
4e-4 of their size."""
SHORTEST = 4.0
"""Shortest segment kept, in periods of the cut-off."""
TRIMMED = 1.5
"""Trimmed length in periods of the cut-off; beyond it accelerations are as accurate as in the middle."""
PART = "/"
"""Separator between a trajectory's label and the number of its part."""
DEGREE = 4
"""Degree of the polynomials, which gives the acceleration a slope and a curvature."""
FEWEST = DEGREE + 2
"""Samples of the shortest segment."""
GROWTH = 1.3
"""Ratio of successive trial numbers of neighbours."""
MOST_POINTS = 401


class Smoothed(NamedTuple):
    """Trajectories with derivatives of filtered coordinates, and the settings used."""

    data: Trajectories
    """q, qd, qdd, tau and temperature at equal steps; other arrays of the log are dropped."""
    cutoff: float
    """Cut-off of the filter, Hz; infinite without a filter."""
    rate: float
    """Sampling rate before decimation, Hz."""
    noise_q: JointVector
    """Standard deviation of the noise of each encoder, rad or m."""
    noise_tau: JointVector
    """Standard deviation of the noise of every torque of `data`, N m or N; zero without torques."""
    choice: Choice | None
    """Reasons for the choice of the cut-off; `None` if it was set."""
    filtered_torque: bool
    decimate: int
    trim: float
    """Time trimmed at both ends of every part, s."""
    parts: int
    """Number of trajectories after cuts at gaps that are not bridged."""
    left_out: int
    """Number of segments that were too short."""
    repeats: Repeats
    """Repeated samples of the log, which were interpolated."""
    clock: Clock | None
    """Times of the source, if they replaced the stamps."""


def smooth(
    data: Trajectories,
    cutoff: float | None = None,
    *,
    filter_torque: bool | None = None,
    decimate: int = 1,
    trim: float | None = None,
) -> Smoothed:
    """Smooths q, t and tau of a log and estimates derivatives; measured rates serve only to correct stamps.

    Args:
        cutoff: Hz, infinite for none (default: chosen from the data, see `filters`).
        filter_torque: whether to filter tau as well (default: only if samples are dropped).
        decimate: keep every `decimate`-th sample.
        trim: time cut off at both ends of every part, s (default: 1.5 periods of the cut-off).

    Raises:
        InputError: settings out of range, a decimated rate below twice the cut-off, or too short segments.
    """
    require_positive(decimate=decimate)
    if trim is not None and not trim >= 0:
        raise InputError(f"trim is {trim}; expected seconds >= 0")
    data, repeats = without_repeats(data)
    of_q = repeats.q[~repeats.rows]
    clock = source_clock(data, of_q)
    if clock is not None:
        data = data._replace(t=clock.t, q=interpolate(clock.t, data.q, data.trajectory, of_q))
    rate = sampling.typical_rate(data)
    d, values = data.degrees_of_freedom, np.hstack([data.q, data.tau])
    pieces = segments(data.t, data.trajectory, gap=max(sampling.BRIDGED, SHORT * rate))
    even = [sampling.even(data.t[piece], values[piece], rate) for piece in pieces]
    values, part = np.concatenate([x for _, x in even]), np.repeat(np.arange(len(even)), [len(t) for t, _ in even])
    noise_q, noise_tau = np.split(noise_of(values, part), [d])
    choice = None
    if cutoff is None:
        choice = choose_cutoff(values[:, :d], part, rate=rate, noise=noise_q)
        cutoff = choice.cutoff
    require_positive(cutoff=cutoff)
    if decimate > 1 and not cutoff < rate / decimate / 2:
        raise InputError(
            f"decimate is {decimate}, which leaves {rate / decimate:g} Hz; expected more than twice the cut-off of "
            f"{cutoff:g} Hz: keep more samples, or lower the cut-off"
        )
    filtered = decimate > 1 if filter_torque is None else filter_torque
    trim = (0.0 if np.isinf(cutoff) else TRIMMED / cutoff) if trim is None else trim
    ends = round(trim * rate)
    shortest = max(6, round(SHORTEST * rate / cutoff) + 1, 2 * ends + 2 * decimate)
    long = [(piece, t, x) for piece, (t, x) in zip(pieces, even, strict=True) if len(t) >= shortest]
    if not long:
        raise InputError(
            f"no segment without a gap has {shortest} samples, four periods of the cut-off at {rate:g} Hz; record "
            "longer motions, or give a higher cut-off"
        )
    parts: list[dict[str, np.ndarray]] = []
    for piece, t, x in long:
        q = low_pass(x[:, :d], rate=rate, cutoff=cutoff)
        qd, qdd = derivatives(q, rate=rate)
        tau = low_pass(x[:, d:], rate=rate, cutoff=cutoff) if filtered else x[:, d:]
        arrays = {"t": t, "q": q, "qd": qd, "qdd": qdd, "tau": tau}
        if data.temperature is not None:
            slow = [np.interp(t, data.t[piece], column) for column in data.temperature[piece].T]
            arrays["temperature"] = np.transpose(slow)
        parts.append({key: array[ends : len(t) - ends : decimate] for key, array in arrays.items()})
    smoothed = data._replace(
        **dict.fromkeys(sampling.DROPPED),
        **{key: np.concatenate([part[key] for part in parts]) for key in parts[0]},
        trajectory=np.repeat(np.arange(len(long)), [len(part["t"]) for part in parts]),
        label=_labels(data, [int(data.trajectory[piece[0]]) for piece, _, _ in long]),
        estimated=tuple(key for key in data.estimated if key == "tau"),
    )
    share = np.sqrt(min(1.0, 2 * cutoff / rate)) if filtered else 1.0
    return Smoothed(
        smoothed,
        cutoff,
        rate,
        noise_q,
        noise_tau * share,
        choice,
        filtered,
        decimate,
        trim,
        len(long),
        left_out=len(pieces) - len(long),
        repeats=repeats,
        clock=clock,
    )


def _labels(data: Trajectories, sources: list[int]) -> np.ndarray:
    """Labels parts by their trajectories, with numbers from 1 if a trajectory was cut."""
    labels = []
    for place, source in enumerate(sources):
        number = f"{PART}{sources[: place + 1].count(source)}" if sources.count(source) > 1 else ""
        labels.append(f"{data.label[source]}{number}")
    return np.array(labels)


def labels_of_parts(data: Trajectories, labels: Sequence[str]) -> list[str]:
    """Replaces the label of each cut trajectory by the labels of its parts."""
    parts = {label: [part for part in data.label if part.rpartition(PART)[0] == label] for label in labels}
    return [part for label in labels for part in ([label] if label in data.label else parts[label] or [label])]


class LocalRates(NamedTuple):
    """Trajectories with q, qd and qdd from local polynomials; other arrays are unchanged."""

    data: Trajectories
    noise: JointVector
    """Standard deviation of the noise of q, rad or m."""
    resolved: Bool[np.ndarray, " d"]
    """Whether more than the fewest neighbours were best; otherwise the noise may be curvature of a coarse motion."""
    rows: np.ndarray
    """Rows of the samples kept."""


def smooth_locally(data: Trajectories) -> LocalRates:
    """Smooths coordinates and estimates their rates from q and t; segments shorter than `FEWEST` are left out.

    Raises:
        InputError: no segment is long enough.
    """
    spread("q", data.q)
    parts = [part for part in segments(data.t, data.trajectory) if len(part) >= FEWEST]
    if not parts:
        raise InputError(f"no segment without a gap has {FEWEST} samples; record longer motions")
    sizes = [FEWEST + (FEWEST % 2 == 0)]  # odd numbers, which centre the window on its sample
    most = min(MOST_POINTS, *map(len, parts))
    while (longer := 2 * int(np.ceil((GROWTH * sizes[-1] - 1) / 2)) + 1) <= most:
        sizes.append(longer)
    fits = np.array(
        [
            np.concatenate([_polynomials(data.t[part], data.q[part], min(size, most)) for part in parts], axis=1)
            for size in sizes
        ]
    )
    best = np.argmin(np.mean(fits[:, 3] ** 2, axis=1), axis=0)
    q, qd, qdd, _, variance = np.moveaxis(fits[best, ..., np.arange(len(best))], 0, -1)
    rows = np.concatenate(parts)
    smoothed = select_samples(data, rows)._replace(q=q, qd=qd, qdd=qdd)
    return LocalRates(smoothed, np.sqrt(np.mean(variance, axis=0)), best > 0, rows)


def _polynomials(t: np.ndarray, q: np.ndarray, size: int) -> Float[np.ndarray, "5 n d"]:
    """Returns q, qd, qdd, leave-one-out errors and noise variances of one segment, from `size` neighbours each.

    Near the ends, fewer neighbours are on one side.
    """
    first = np.clip(np.arange(len(t)) - size // 2, 0, len(t) - size)
    around = first[:, None] + np.arange(size)
    unit = 0.5 * (t[-1] - t[0]) * size / len(t)
    powers = ((t[around] - t[:, None]) / unit)[..., None] ** np.arange(DEGREE + 1)
    # The normal equations are safe here: the matrices are small and times are scaled.
    inverse = np.linalg.solve(powers.mT @ powers, powers.mT)
    value, slope, bend = (np.einsum("ns,nsd->nd", inverse[:, order], q[around]) for order in range(3))
    own = 1 - inverse[np.arange(len(t)), 0, np.arange(len(t)) - first][:, None]
    residual = q - value
    return np.array([value, slope / unit, 2 * bend / unit**2, residual / own, residual**2 / own])
