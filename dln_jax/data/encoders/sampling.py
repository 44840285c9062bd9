"""Sampling times: rate, gaps, and resampling to equal steps."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dln_jax.data.splits import GAP
from dln_jax.types import InputError

BRIDGED = 3.5
"""Gaps up to this multiple of the median step are interpolated; longer ones cut a trajectory."""
EVEN = 1e-3
"""Relative deviation from equal steps up to which samples are not resampled."""


class Timing(NamedTuple):
    """Sampling rate, jitter and gaps of a log."""

    rate: float
    """Hz, from the median over trajectories of their median steps."""
    jitter: float
    """Standard deviation of the steps without gaps, relative to the median step; largest over trajectories."""
    gaps: int
    """Number of steps longer than `GAP` times the median."""
    longest: float
    """s, the longest step."""
    rates: Float[np.ndarray, " K"]
    """Hz, for every trajectory with two samples or more."""


def timing(t: Float[np.ndarray, " N"], trajectory: Int[np.ndarray, " N"]) -> Timing:
    """Computes rate, jitter and gaps.

    Raises:
        InputError: no trajectory has two samples.
    """
    steps = [np.diff(part) for part in _parts(t, trajectory) if len(part) > 1]
    if not steps:
        raise InputError("no trajectory has two samples; a rate takes motions: record some")
    typical = np.array([np.median(each) for each in steps])
    whole = [each[each <= GAP * step] for each, step in zip(steps, typical, strict=True)]
    return Timing(
        rate=float(1 / np.median(typical)),
        jitter=float(max(each.std() / step for each, step in zip(whole, typical, strict=True))),
        gaps=int(sum(np.sum(each > GAP * step) for each, step in zip(steps, typical, strict=True))),
        longest=float(max(each.max() for each in steps)),
        rates=1 / typical,
    )


def even(
    t: Float[np.ndarray, " n"], values: Float[np.ndarray, "n k"], rate: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m k"]]:
    """One segment at equal steps from its first sample: unchanged if equally spaced, else by a cubic spline."""
    # The margins keep the last sample if rounding puts it just below a whole step.
    count = int(np.floor((t[-1] - t[0]) * rate * (1 + 1e-9) + 1e-6)) + 1
    uniform = t[0] + np.arange(count) / rate
    if count == len(t) and np.abs(t - uniform).max() * rate < EVEN:
        return uniform, values
    from scipy.interpolate import make_interp_spline

    return uniform, make_interp_spline(t, values, k=min(3, len(t) - 1), axis=0)(np.minimum(uniform, t[-1]))


def _parts(values: np.ndarray, trajectory: np.ndarray) -> list[np.ndarray]:
    """Values of every trajectory; their samples are contiguous."""
    return np.split(values, np.flatnonzero(np.diff(trajectory)) + 1)
