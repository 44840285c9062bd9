"""How noisy a channel is, from what changes between neighbouring samples.

Differences of order m of white noise of standard deviation s have the variance s² C(2m, m), while those of a slow
signal vanish as (2 pi f / rate)^m. Their median size is deaf to rare jumps, such as those of dry friction when a joint
turns round. The smallest of several orders is taken: what a signal leaves in one makes it larger.
"""

import math

import numpy as np
from jaxtyping import Float, Int

from dln_jax.data.schema import Trajectories

ORDERS = (2, 3, 4, 5, 6)
NORMAL = 0.67448975
"""Median size of a normal variable, in standard deviations."""

SLOW = 5e-3
"""Share of the positions' standard deviation that differences of a log take for noise, above which it is sampled so
slowly that they are differences of the motion."""


def noise_of(values: Float[np.ndarray, "N k"], trajectory: Int[np.ndarray, " N"]) -> Float[np.ndarray, " k"]:
    """Standard deviation of the white noise of each channel, in its unit, at least that of its steps, step / √12.

    Samples are at equal steps but for gaps, whose differences are rare; trajectories of fewer than seven samples are
    left out. Zero where a channel does not vary, infinite where there are no such trajectories.
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
    """Standard deviation of the white noise of each torque, N m or N; `None` if the samples are too far apart to tell.

    Differences of positions, which are measured far better than torques, show whether they are.
    """
    spread = data.q.std(axis=0)
    moving = spread > 0
    if not moving.any() or not (noise_of(data.q, data.trajectory)[moving] <= SLOW * spread[moving]).all():
        return None
    return noise_of(data.tau, data.trajectory)


def step_of(values: Float[np.ndarray, "N k"]) -> Float[np.ndarray, " k"]:
    """The step in which each channel moves, as an encoder does; zero where it has no levels."""
    return np.array([_step(channel) for channel in values.T])


def _step(channel: np.ndarray) -> float:
    size = np.abs(channel).max(initial=0.0)
    levels = np.unique(np.round(channel, 12 - int(np.ceil(np.log10(size)))) if size > 0 else channel)
    if len(levels) < 3:
        return 0.0
    distances = np.diff(levels)
    smallest = float(distances.min())
    multiples = distances / smallest
    # Rounding of the log moves levels a little.
    return smallest if np.mean(np.abs(multiples - np.round(multiples)) < 0.05) > 0.99 else 0.0
