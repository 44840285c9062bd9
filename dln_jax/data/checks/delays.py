"""Helpers for time shifts: interior samples, and minima between samples."""

import numpy as np
from jaxtyping import Int


def vertex(values: np.ndarray, lowest: int) -> float:
    """Offset of the minimum of the parabola through the lowest value and its neighbours, in steps."""
    if not 0 < lowest < len(values) - 1:
        return 0.0
    before, here, after = values[lowest - 1 : lowest + 2]
    curvature = before - 2 * here + after
    return float(0.5 * (before - after) / curvature) if curvature > 0 else 0.0


def away_from_ends(part: Int[np.ndarray, " N"], farthest: int) -> Int[np.ndarray, " n"]:
    """Indices of samples with `farthest` neighbours of the same part on either side."""
    places = np.arange(farthest, len(part) - farthest)
    return places[(part[places - farthest] == part[places]) & (part[places + farthest] == part[places])]
