"""Samples in time: their rate and gaps, and a stretch at equal steps."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dln_jax.data.stretches import GAP
from dln_jax.types import InputError

BRIDGED = 3.5
"""Times the median time step: gaps up to it are interpolated, longer ones cut a trajectory."""
EVEN = 1e-3
"""Deviation from equal steps, relative to the step, below which samples are left where they are."""


class Timing(NamedTuple):
    """How a log was sampled."""

    rate: float
    """Hz: the median over trajectories of each one's median step."""
    jitter: float
    """Standard deviation of the steps without gaps, relative to the median step; the worst trajectory's."""
    gaps: int
    """Steps longer than `GAP` median ones."""
    longest: float
    """s, the longest step."""
    rates: Float[np.ndarray, " K"]
    """Hz, of each trajectory with two samples or more."""


def timing(t: Float[np.ndarray, " N"], trajectory: Int[np.ndarray, " N"]) -> Timing:
    """Rate, jitter and gaps.

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
    """One stretch at equal steps from its first sample: as it is where it has them, else a cubic spline through it."""
    count = int(np.floor((t[-1] - t[0]) * rate * (1 + 1e-9) + 1e-6)) + 1
    uniform = t[0] + np.arange(count) / rate
    if count == len(t) and np.abs(t - uniform).max() * rate < EVEN:
        return uniform, values
    from scipy.interpolate import make_interp_spline

    return uniform, make_interp_spline(t, values, k=min(3, len(t) - 1), axis=0)(np.minimum(uniform, t[-1]))


def _parts(values: np.ndarray, trajectory: np.ndarray) -> list[np.ndarray]:
    """The values of each trajectory, whose samples are together."""
    return np.split(values, np.flatnonzero(np.diff(trajectory)) + 1)
