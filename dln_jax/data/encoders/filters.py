"""A low-pass filter without delay, the choice of its cut-off frequency, and derivatives of the filtered signal.

A Butterworth filter runs forwards and backwards (Gustafsson 1996), with the gain

    H(f) = 1 / (1 + (f / cutoff)^(2 order))

without a time shift; the gain at the cut-off is ½. The filter is linear and commutes with a model that is linear in its
parameters, F(Phi theta) = F(Phi) theta. If you apply `low_pass` to the torques, apply it to the columns of Phi too.
Columns of a filtered q are not filtered columns if a force, such as dry friction, has a wider band than the motion.

At the ends the filter sees one side only. It subtracts a slow polynomial and extends the signal by reflection, which
makes accelerations there 2 to 40 times more accurate. From 1.5 periods on they are as accurate as elsewhere.

A quintic spline through the filtered samples gives the derivatives. A second derivative is exact to 0.02 % at a tenth
of the rate and to 1.3 % at a quarter; two central differences lose 12 % and 60 % there.

The cut-off minimises the expected error of accelerations. The spectrum of a coordinate is the sum of the motion's
spectrum S(f) and a white noise floor N. A filter of gain H removes the fraction 1 - H of the motion's acceleration and
passes the fraction H of the noise:

    E(cutoff) = sum over joints of  integral (2 pi f)^4 [(1 - H)² S + H² N] df  /  integral (2 pi f)^4 S df

For a steep filter the minimum lies where S = N for derivatives of any order, so one cut-off serves q, qd and qdd.
Spectra of second differences are averaged (Welch 1967) and divided by the gain of the differences, so that the motion
does not leak into the floor.

A single jump can dominate a spectrum, which is a mean of squares, but not the noise, which is a median. Jumps are
therefore interpolated before spectra are taken. A flat top of a spectrum above the median's floor is the floor. Noise
need not be white: a spectrum of accelerations that rises up to the highest frequency is noise. Periodic motions have
lines with only noise between them, so neither rule ends a motion in a gap.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.encoders.sampling import NORMAL, by_trajectory, spline
from dln_jax.types import InputError, JointSamples, JointVector, SampleIndex, require_positive

ORDER = 4
"""Order of the Butterworth filter, which is applied twice."""
PERIODS = 3
"""Length of the reflected extension at both ends of a segment, in periods of the cut-off."""
END_PERIODS, END_DEGREE = 1.0, 5
"""Length in periods of the cut-off, and degree, of the polynomial that estimates values at an end."""
SEGMENT = 8.0
"""s: length of the segments over which spectra are averaged."""
SEEN = 1.5
"""A smoothed spectrum above this multiple of the floor belongs to the motion."""
CANDIDATES = 200
TOP = 0.45
"""Highest cut-off tried, as a fraction of the sampling rate."""
MOVES = 2.0
"""A joint counts as moving if its standard deviation exceeds this multiple of its noise."""
WORTH = 1e-4
"""A filter is applied if the relative error of unfiltered accelerations is larger."""
JUMP = 8.0
"""A jump differs from its neighbours' prediction by more than this many standard deviations."""
RARE = 0.1
"""Largest fraction of samples that can be jumps; a larger one is a motion, or noise that is not white."""
DEVIATION = np.array([-1, 6, -15, 20, -15, 6, -1]) / 20
"""Weights of seven samples for the deviation of the middle one from the quintic through the others."""
PREDICTION = math.sqrt(1 + 524 / 400)
"""Standard deviation of the prediction error, in units of the noise."""
MEDIAN = math.log(2)
"""Ratio of the median of a spectrum's lines to their mean, if few segments are averaged."""
RISES = 3.0
"""A spectrum of accelerations that exceeds its minimum by this factor at high frequencies is noise there."""
GAP = 3.3
"""Widest gap between the lines of a periodic motion, as a ratio of frequencies: odd harmonics begin with 1 and 3."""
SHALLOW = 30.0
"""A spectrum of accelerations has a shallow minimum if its peak is less than this multiple of it."""
FLAT = 4.0
"""Largest ratio between the thirds of the upper half of a spectrum for it to count as flat."""


class Choice(NamedTuple):
    """The cut-off, and the quantities it was chosen from (for plots)."""

    cutoff: float
    """Hz; infinite if the noise is too small for a filter."""
    tried: Float[np.ndarray, " C"]
    """Cut-offs tried, Hz."""
    error: Float[np.ndarray, " C"]
    """E of every cut-off: expected squared relative error of the accelerations, mean over joints."""
    f: Float[np.ndarray, " F"]
    """Hz."""
    spectrum: Float[np.ndarray, "F d"]
    """Spectrum of q, (rad or m)² / Hz."""
    floor: JointVector
    """White part of N, in the same unit."""


def gain(f: Float[np.ndarray, " n"], cutoff: float) -> Float[np.ndarray, " n"]:
    """Returns the gain H of both passes; 1 for an infinite cut-off."""
    return 1 / (1 + (f / cutoff) ** (2 * ORDER))


def low_pass(values: Float[np.ndarray, "N k"], *, rate: float, cutoff: float) -> Float[np.ndarray, "N k"]:
    """Low-pass filters values of one trajectory at equal steps.

    Args:
        values: columns of any quantity linear in the unknowns: torques, or columns of a regressor.
        rate: sampling rate, Hz.
        cutoff: Hz; infinite returns the values unchanged.

    Raises:
        InputError: the cut-off is not below half the rate.
    """
    require_positive(rate=rate, cutoff=cutoff)
    if np.isinf(cutoff):
        return values
    if not cutoff < rate / 2:
        raise InputError(f"cutoff is {cutoff:g} Hz; expected less than {rate / 2:g} Hz, half the rate of the samples")
    from scipy.signal import butter, sosfiltfilt

    slow = _between_ends(values, int(np.ceil(END_PERIODS * rate / cutoff)))
    extension = min(int(np.ceil(PERIODS * rate / cutoff)), len(values) - 1)
    return slow + sosfiltfilt(butter(ORDER, cutoff, fs=rate, output="sos"), values - slow, axis=0, padlen=extension)


def _between_ends(values: np.ndarray, near: int) -> np.ndarray:
    """Returns the quintic with the value, slope and curvature of values [n, k] at both ends, from `near` samples each.

    After subtracting it, the values are straight at their ends, where the filter reflects them. The quintic is slow
    enough to pass every filter. Zero for fewer than twice `near` samples.
    """
    near = max(near, 2 * END_DEGREE)
    if len(values) < 2 * near:
        return np.zeros_like(values)
    from numpy.polynomial.polynomial import polyfit
    from scipy.interpolate import BPoly

    x = np.linspace(0.0, 1.0, len(values))  # along the segment
    length, ends = x[near - 1], []
    for samples, end in ((slice(None, near), 0.0), (slice(-near, None), 1.0)):
        # Scale x by the length of the fit, which keeps the fit well conditioned.
        fit = polyfit((x[samples] - end) / length, values[samples], END_DEGREE)
        ends.append([fit[0], fit[1] / length, 2 * fit[2] / length**2])
    return BPoly.from_derivatives([0.0, 1.0], np.array(ends))(x)


def derivatives(
    q: Float[np.ndarray, "n k"], *, rate: float
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
    """Returns qd and qdd of one segment at equal steps by a quintic spline; `InputError` for fewer than six samples."""
    require_positive(rate=rate)
    if len(q) < 6:
        raise InputError(f"a segment has {len(q)} samples, but derivatives need at least 6; record longer motions")
    t = np.arange(len(q)) / rate
    curve = spline(t, q, 5)
    return curve(t, nu=1), curve(t, nu=2)


def choose_cutoff(q: JointSamples, trajectory: SampleIndex, *, rate: float, noise: JointVector) -> Choice:
    """Finds the cut-off with the lowest expected error.

    Args:
        q: coordinates at equal steps.
        rate: Hz.
        noise: standard deviation of the noise of every coordinate.

    Raises:
        InputError: no segment has sixteen samples, or nothing moves by more than its noise.
    """
    require_positive(rate=rate)
    f, spectrum = _spectra(_without_jumps(q, trajectory, noise), trajectory, rate=rate)
    white = np.maximum(2 * noise**2 / rate, _flat_top(f, spectrum))
    floor = np.maximum(white, _rising(f, spectrum, white))
    # The motion's spectrum S ends where the mean spectrum falls to the floor and stays there for more than a gap.
    seen = _mean(spectrum) >= SEEN * _mean(floor)
    hidden = np.cumsum(~_highest(seen, 1.0, GAP), axis=0) > 0
    signal = np.where(hidden, 0.0, np.maximum(spectrum - floor, 0.0))
    tried = np.geomspace(max(f[0], rate / 500), TOP * rate, CANDIDATES)
    weight = (2 * np.pi * f) ** 4
    sizes = weight @ signal
    moves = (sizes > 0) & (q.std(axis=0) > MOVES * noise)
    if not moves.any():
        raise InputError("no joint moves by more than its noise, so no cut-off can be chosen; give one, or check q")
    errors = []
    for cutoff in (*tried, np.inf):
        H = gain(f, cutoff)[:, None]
        left = weight @ ((1 - H) ** 2 * signal + H**2 * floor)
        errors.append(np.mean(left[moves] / sizes[moves]))
    *error, raw = errors
    cutoff = float(tried[np.argmin(error)]) if raw > WORTH**2 else np.inf
    return Choice(cutoff, tried, np.array(error), f, spectrum, white)


def _without_jumps(values: np.ndarray, trajectory: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Interpolates jumps: rare samples of channels [N, k] that neither noise [k] nor the motion explains.

    A quintic through three samples on either side predicts each sample. A jump has an error of many standard deviations
    of the noise and of the errors elsewhere.
    """
    from scipy.ndimage import correlate1d, maximum_filter1d

    inside = np.pad(trajectory[6:] == trajectory[:-6], 3)
    if not inside.any():
        return values
    errors = np.abs(correlate1d(values, DEVIATION, axis=0)) * inside[:, None]
    usual = np.maximum(PREDICTION * noise, np.median(errors[inside], axis=0) / NORMAL)
    # A jump also causes errors in neighbouring samples; only the largest error nearby counts.
    wrong = (errors > JUMP * usual) & (errors == maximum_filter1d(errors, 7, axis=0))
    values, places = values.copy(), np.arange(len(values))
    for channel in np.flatnonzero(wrong.any(axis=0) & (wrong.mean(axis=0) < RARE)):
        bad = wrong[:, channel]
        values[bad, channel] = spline(places[~bad], values[~bad, channel], 5)(places[bad])
    return values


def _flat_top(f: np.ndarray, spectrum: np.ndarray) -> np.ndarray:
    """Returns the level [d] of the upper half of a spectrum [F, d] if it is flat, like white noise; else zero."""
    levels = [np.median(part, axis=0) for part in np.array_split(spectrum[f > f[-1] / 2], 3)]
    lowest = np.min(levels, axis=0)
    return np.where(np.max(levels, axis=0) < FLAT * lowest, lowest / MEDIAN, 0.0)


def _rising(f: np.ndarray, spectrum: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Returns the noisy part of a spectrum [F, d]: above the minimum of the acceleration power, if it rises from there.

    Forces of finite power cause a falling spectrum of accelerations, so a rising one is noise, white or not. Timing
    jitter of a fraction of a step, for example, is noise proportional to the velocity. Zero if the minimum is shallow
    and the white floor explains the highest frequencies: motion, such as chatter of motors, lies in between.
    """
    logarithm = np.log(np.maximum(spectrum, np.finfo(float).tiny))
    accelerations = f[:, None] ** 4 * np.exp(_mean(logarithm))  # geometric mean
    envelopes = _highest(f[:, None] ** 4 * _mean(spectrum), math.sqrt(1 / GAP), math.sqrt(GAP))
    rising = np.zeros_like(spectrum)
    for channel, (power, envelope) in enumerate(zip(accelerations.T, envelopes.T, strict=True)):
        peak = int(np.argmax(power[f < f[-1] / 4]))
        lowest, of_envelope = (peak + int(np.argmin(values[peak:])) for values in (power, envelope))
        if math.sqrt(GAP) * f[lowest] < f[of_envelope]:  # a gap
            lowest = of_envelope
        top = f > f[-1] / 2
        explained = np.median(spectrum[top, channel]) < RISES * MEDIAN * white[channel]
        shallow = power[peak] < SHALLOW * power[lowest]
        if not (explained and shallow) and power[top].min() > RISES * power[lowest]:
            rising[lowest:, channel] = spectrum[lowest:, channel]
    return rising


def _spectra(values: np.ndarray, trajectory: np.ndarray, *, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns positive frequencies [F], Hz, F >= 7, and mean power spectra [F, k] of channels [N, k], unit² / Hz.

    Raises:
        InputError: no trajectory has sixteen samples.
    """
    from scipy.signal import welch

    parts = [part for part in by_trajectory(values, trajectory) if len(part) >= 16]
    if not parts:
        raise InputError(
            "no segment has the 16 samples that a spectrum needs; record longer motions, or give a cut-off"
        )
    length = min(max(len(part) for part in parts) - 2, max(14, round(SEGMENT * rate)))
    f, powers = np.zeros(0), []
    for part in parts:
        changes = np.diff(part, n=2, axis=0)
        padded = np.pad(changes, ((0, max(length - len(changes), 0)), (0, 0)))
        f, power = welch(padded, fs=rate, nperseg=length, axis=0)
        powers.append(len(part) * power[1:] * (length / min(length, len(changes))))  # zeros have no power
    power = sum(powers) / sum(map(len, parts))
    return f[1:], power / (2 * np.sin(np.pi * f[1:, None] / rate)) ** 4


def _mean(spectrum: np.ndarray) -> np.ndarray:
    """Averages a spectrum [F, d] over a sixth of an octave on either side, which preserves lines."""
    summed = np.pad(np.cumsum(spectrum, axis=0), ((1, 0), (0, 0)))
    low, high = _window(len(spectrum), 2 ** (-1 / 6), 2 ** (1 / 6))
    return (summed[high] - summed[low]) / (high - low)[:, None]


def _highest(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Returns the maximum over frequencies between `low` and `high` times each frequency."""
    return np.stack([values[a:b].max(axis=0) for a, b in zip(*_window(len(values), low, high), strict=True)])


def _window(count: int, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the index range of frequencies between `low` and `high` times each frequency."""
    place = np.arange(1, count + 1)
    first = np.maximum(np.floor(place * low).astype(int) - 1, 0)
    return first, np.minimum(np.ceil(place * high).astype(int), count)
