"""Stretches of a trajectory without a gap, a time step much longer than the others, and windows within them."""

import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.types import InputError

GAP = 1.5
"""Times the median time step: a longer step is a gap."""


def stretches(data: Trajectories, *, gap: float = GAP) -> list[np.ndarray]:
    """Indices of the samples of each stretch without a gap, in order.

    Raises:
        InputError: a gap that is not longer than the median time step.
    """
    if not gap > 1:
        raise InputError(f"gap is {gap}; expected a multiple of the median time step above 1")
    same = np.diff(data.trajectory) == 0
    steps = np.diff(data.t)
    if not same.any():
        raise InputError("no trajectory has two samples; windows need motions: record some")
    broken = ~same | (steps > gap * np.median(steps[same]))
    return np.split(np.arange(len(data.t)), np.flatnonzero(broken) + 1)


def window_indices(data: Trajectories, length: int, *, gap: float = GAP) -> tuple[np.ndarray, np.ndarray]:
    """Samples of consecutive windows [W, T], each of which begins with the last one of that before; and their weight.

    Windows lie within stretches without a gap. What remains of a stretch is a shorter window, which repeats its last
    sample with weight 0.

    Raises:
        InputError: a length below 2, or no two samples without a gap between them.
    """
    if length < 2:
        raise InputError(f"length is {length}; expected a window of at least 2 samples")
    pieces = [
        stretch[first : first + length]
        for stretch in stretches(data, gap=gap)
        for first in range(0, len(stretch) - 1, length - 1)
    ]
    if not pieces:
        raise InputError("there are no two samples without a gap between them; record longer motions")
    indices = np.stack([np.pad(piece, (0, length - len(piece)), mode="edge") for piece in pieces])
    return indices, np.stack([np.arange(length) < len(piece) for piece in pieces]).astype(float)
