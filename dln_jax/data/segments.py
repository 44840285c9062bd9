"""Segments of a trajectory without a gap (a time step much longer than the others), and windows within them."""

import numpy as np
from jaxtyping import Float, Int

from dln_jax.data.schema import Trajectories
from dln_jax.types import InputError

GAP = 1.5
"""A step longer than this multiple of its trajectory's median step is a gap."""


def segments(
    t: Float[np.ndarray, " N"], trajectory: Int[np.ndarray, " N"], *, gap: float = GAP
) -> list[Int[np.ndarray, " n"]]:
    """Sample indices of the segments of all trajectories, cut at steps longer than `gap` times the median step.

    Raises:
        InputError: `gap` is not above 1, or no trajectory has two samples.
    """
    if not gap > 1:
        raise InputError(f"gap is {gap}; expected a multiple of the median time step above 1")
    if not (np.diff(trajectory) == 0).any():
        raise InputError("no trajectory has two samples; these are no motions: record some")
    found = []
    for samples in np.split(np.arange(len(t)), np.flatnonzero(np.diff(trajectory)) + 1):
        steps = np.diff(t[samples])
        longest = gap * np.median(steps) if len(steps) else np.inf
        found.extend(np.split(samples, np.flatnonzero(steps > longest) + 1))
    return found


def window_indices(data: Trajectories, length: int, *, gap: float = GAP) -> tuple[np.ndarray, np.ndarray]:
    """Sample indices [W, T] of consecutive windows, which share their end samples, and the weights of the samples.

    Windows lie within segments. The remainder of a segment is a shorter window, padded with its last sample at weight
    0.

    Raises:
        InputError: a length below 2, or no two samples without a gap between them.
    """
    if length < 2:
        raise InputError(f"length is {length}; expected a window of at least 2 samples")
    pieces = [
        segment[first : first + length]
        for segment in segments(data.t, data.trajectory, gap=gap)
        for first in range(0, len(segment) - 1, length - 1)
    ]
    if not pieces:
        raise InputError("there are no two samples without a gap between them; record longer motions")
    indices = np.stack([np.pad(piece, (0, length - len(piece)), mode="edge") for piece in pieces])
    return indices, np.stack([np.arange(length) < len(piece) for piece in pieces]).astype(float)
