"""Shifts in time: which samples have neighbours, and the lowest point between samples."""

import numpy as np
from jaxtyping import Int


def vertex(values: np.ndarray, lowest: int) -> float:
    """Where the parabola through a lowest value and its neighbours has its own lowest, in steps from it."""
    if not 0 < lowest < len(values) - 1:
        return 0.0
    before, here, after = values[lowest - 1 : lowest + 2]
    curvature = before - 2 * here + after
    return float(0.5 * (before - after) / curvature) if curvature > 0 else 0.0


def away_from_ends(part: Int[np.ndarray, " N"], farthest: int) -> Int[np.ndarray, " n"]:
    """Samples with so many neighbours on both sides in their own part."""
    places = np.arange(farthest, len(part) - farthest)
    return places[(part[places - farthest] == part[places]) & (part[places + farthest] == part[places])]
