"""Converts q, t and tau of a log to trajectories with derivatives.

1. Repeated rows are removed (see `repeats`), and stamps of arrival are replaced by the source's times (see `clock`),
   which is all that measured rates serve for. Long gaps cut a trajectory into parts named LABEL/1, LABEL/2 and so on,
   short ones are bridged; samples at unequal steps are interpolated to one rate.
2. The noise of every channel is estimated. The noise and the spectra of q determine the cut-off, unless it is set.
3. q is filtered without delay; qd and qdd are derivatives of the result. tau is filtered too if samples are dropped,
   which requires it, or on request.
4. Ends, where a filter knows one side only, are trimmed, and every k-th sample is kept.

Torques are not filtered by default: least squares average out their noise, while filtered torques of a model with dry
friction belong to no state, see `filters`. On a simulated seven-axis arm filtering them cost a factor of 1.6
(`scripts.reports.robots.known_kinematics`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.encoders import sampling
from dln_jax.data.encoders.clock import Clock, source_clock
from dln_jax.data.encoders.cutoff import Choice, choose_cutoff
from dln_jax.data.encoders.filters import derivatives, low_pass
from dln_jax.data.encoders.repeats import Repeats, interpolated, without_repeats
from dln_jax.data.encoders.sampling import noise_of
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import segments
from dln_jax.types import InputError, require_positive

SHORT = 0.01
"""s: gaps up to this length are bridged, too, whatever the rate: a cubic spline through motions of 10 Hz is off by 4e-4
of their size at most."""
SHORTEST = 4.0
"""Shortest segment kept, in periods of the cut-off."""
TRIMMED = 1.5
"""Trimmed length in periods of the cut-off; beyond it accelerations are as accurate as in the middle."""
PART = "/"
"""Separator between a trajectory's label and the number of its part."""


class Smoothed(NamedTuple):
    """Trajectories with derivatives of filtered coordinates, and the settings used."""

    data: Trajectories
    """q, qd, qdd, tau and temperature at equal steps; other arrays of the log are dropped."""
    cutoff: float
    """Cut-off of the filter, Hz; infinite without a filter."""
    rate: float
    """Sampling rate before decimation, Hz."""
    noise_q: Float[np.ndarray, " d"]
    """Standard deviation of every encoder's noise, rad or m."""
    noise_tau: Float[np.ndarray, " d"]
    """Standard deviation of the noise of every torque of `data`, N m or N; zero without torques."""
    choice: Choice | None
    """Data behind the choice of the cut-off; `None` if the cut-off was set."""
    filtered_torque: bool
    decimate: int
    trim: float
    """Time trimmed at both ends of every part, s."""
    bridged: int
    """Number of interpolated gaps."""
    parts: int
    """Number of trajectories after cuts at longer gaps."""
    left_out: int
    """Number of segments that were too short."""
    repeats: Repeats
    """Repeated samples of the log, which were resampled over."""
    clock: Clock | None
    """Times of the source, if they replaced the stamps."""


def smooth(
    data: Trajectories,
    cutoff: float | None = None,
    *,
    rate: float | None = None,
    filter_torque: bool | None = None,
    decimate: int = 1,
    trim: float | None = None,
) -> Smoothed:
    """Estimates derivatives and smooths a log's q, t and tau for learning; existing rates only correct stamps.

    Args:
        cutoff: Hz, infinite for none (default: chosen from the data, see `cutoff`).
        rate: rate of the equal steps, Hz (default: the median of the data).
        filter_torque: whether to filter tau as well (default: only if samples are dropped).
        decimate: keep every `decimate`-th sample.
        trim: time cut off at both ends of every part, s (default: 1.5 periods of the cut-off).

    Raises:
        InputError: settings out of range, a decimation below twice the cut-off, or no segment that is long enough.
    """
    require_positive(decimate=decimate)
    if trim is not None and not trim >= 0:
        raise InputError(f"trim is {trim}; expected seconds >= 0")
    data, repeats = without_repeats(data)
    of_q = (repeats.q & ~repeats.rows)[~repeats.rows]
    clock = source_clock(data, of_q)
    if clock is not None:
        data = data._replace(t=clock.t, q=interpolated(clock.t, data.q, data.trajectory, of_q))
    if rate is None:
        # Rounding removes the rounding errors of time differences.
        rate = float(f"{sampling.timing(data.t, data.trajectory).rate:.9g}")
    require_positive(rate=rate)
    d, values = data.degrees_of_freedom, np.hstack([data.q, data.tau])
    pieces = segments(data.t, data.trajectory, gap=max(sampling.BRIDGED, SHORT * rate))
    even = [sampling.even(data.t[piece], values[piece], rate) for piece in pieces]
    values, part = np.concatenate([x for _, x in even]), np.repeat(np.arange(len(even)), [len(t) for t, _ in even])
    noise_q, noise_tau = (noise_of(channels, part) for channels in (values[:, :d], values[:, d:]))
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
    kept = [index for index, (t, _) in enumerate(even) if len(t) >= shortest]
    if not kept:
        raise InputError(
            f"no segment without a gap has {shortest} samples, four periods of the cut-off at {rate:g} Hz; record "
            "longer motions, or give a higher cut-off"
        )
    slow = data.temperature
    columns: dict[str, list[np.ndarray]] = {key: [] for key in ("t", "q", "qd", "qdd", "tau")}
    temperatures: list[np.ndarray] = []
    for index in kept:
        t, x = even[index]
        if slow is not None:
            known = pieces[index]
            of_joints = [np.interp(t, data.t[known], column) for column in slow[known].T]
            temperatures.append(np.stack(of_joints, axis=1)[ends : len(t) - ends : decimate])
        arrays = t, *_filtered(x[:, :d], x[:, d:], rate, cutoff, filter_torque=filtered)
        for key, array in zip(columns, arrays, strict=True):
            columns[key].append(array[ends : len(t) - ends : decimate])
    smoothed = data._replace(
        **{key: np.concatenate(parts) for key, parts in columns.items()},
        trajectory=np.repeat(np.arange(len(kept)), [len(t) for t in columns["t"]]),
        label=_labels(data, [int(data.trajectory[pieces[index][0]]) for index in kept]),
        **dict.fromkeys(("p", "pd", "tau_inertial", "tau_coriolis", "tau_gravity")),
        temperature=None if slow is None else np.concatenate(temperatures),
        estimated=tuple(key for key in data.estimated if key == "tau"),
    )
    share = np.sqrt(min(1.0, 2 * cutoff / rate)) if filtered else 1.0
    return Smoothed(
        smoothed, cutoff, rate, noise_q, noise_tau * share, choice, filtered, decimate, trim,
        bridged=len(segments(data.t, data.trajectory)) - len(pieces), parts=len(kept),
        left_out=len(pieces) - len(kept), repeats=repeats, clock=clock,
    )  # fmt: skip


def _filtered(
    q: np.ndarray, tau: np.ndarray, rate: float, cutoff: float, *, filter_torque: bool
) -> tuple[np.ndarray, ...]:
    q = low_pass(q, rate=rate, cutoff=cutoff)
    return q, *derivatives(q, rate=rate), low_pass(tau, rate=rate, cutoff=cutoff) if filter_torque else tau


def _labels(data: Trajectories, sources: list[int]) -> np.ndarray:
    """Labels of parts by the trajectories that they come from; parts of one trajectory are numbered from 1."""
    counts = [sources[: place + 1].count(source) for place, source in enumerate(sources)]
    return np.array(
        [
            str(data.label[source]) + (f"{PART}{count}" if sources.count(source) > 1 else "")
            for source, count in zip(sources, counts, strict=True)
        ]
    )


def labels_of_parts(data: Trajectories, labels: Sequence[str]) -> list[str]:
    """Labels after smoothing: the label of a trajectory that was cut becomes those of its parts; others stay."""
    parts = {label: [part for part in data.label if part.rpartition(PART)[0] == label] for label in labels}
    return [part for label in labels for part in ([label] if label in data.label else parts[label] or [label])]
