"""Noise of a channel, estimated from differences of neighbouring samples.

Differences of order m of white noise of standard deviation s have the variance s² C(2m, m), while those of a slow
signal vanish as (2 pi f / rate)^m. Their median size is insensitive to rare jumps, such as those of dry friction when a
joint reverses. The smallest estimate of several orders is used, since any remaining signal increases an estimate.
"""

import math

import numpy as np
from jaxtyping import Float, Int

from dln_jax.data.schema import Trajectories

ORDERS = (2, 3, 4, 5, 6)
NORMAL = 0.67448975
"""Median absolute value of a standard normal variable."""

SLOW = 5e-3
"""If differences of a log give a noise above this fraction of the positions' standard deviation, sampling is so slow
that they are differences of the motion."""


def noise_of(values: Float[np.ndarray, "N k"], trajectory: Int[np.ndarray, " N"]) -> Float[np.ndarray, " k"]:
    """Standard deviation of the white noise of every channel, in its unit, at least that of its steps, step / √12.

    Samples are at equal steps except for gaps, which are rare; trajectories of fewer than seven samples are ignored.
    Zero for a constant channel, infinite if there are no such trajectories.
    """
    parts = [part for part in np.split(values, np.flatnonzero(np.diff(trajectory)) + 1) if len(part) > max(ORDERS)]
    if not parts:
        return np.full(values.shape[1], np.inf)
    of_orders = []
    for order in ORDERS:
        changes = np.abs(np.concatenate([np.diff(part, n=order, axis=0) for part in parts]))
        of_orders.append(np.median(changes, axis=0) / (NORMAL * math.sqrt(math.comb(2 * order, order))))
    return np.maximum(np.min(of_orders, axis=0), step_of(values) / math.sqrt(12))


def torque_noise(data: Trajectories) -> Float[np.ndarray, " d"] | None:
    """Standard deviation of the white noise of every torque, N m or N; `None` if the sampling is too slow to tell.

    The noise of the positions, which are measured much better than torques, shows whether it is.
    """
    spread = data.q.std(axis=0)
    moving = spread > 0
    if not moving.any() or not (noise_of(data.q, data.trajectory)[moving] <= SLOW * spread[moving]).all():
        return None
    return noise_of(data.tau, data.trajectory)


def step_of(values: Float[np.ndarray, "N k"]) -> Float[np.ndarray, " k"]:
    """Step size of every channel, such as an encoder's resolution; zero for a channel without levels."""
    return np.array([_step(channel) for channel in values.T])


def _step(channel: np.ndarray) -> float:
    size = np.abs(channel).max(initial=0.0)
    # Twelve significant digits, so that rounding errors do not split a level.
    levels = np.unique(np.round(channel, 12 - int(np.ceil(np.log10(size)))) if size > 0 else channel)
    if len(levels) < 3:
        return 0.0
    distances = np.diff(levels)
    smallest = float(distances.min())
    multiples = distances / smallest
    # Rounding in the log moves levels slightly.
    return smallest if np.mean(np.abs(multiples - np.round(multiples)) < 0.05) > 0.99 else 0.0
