"""Coverage of predicted standard deviations: how often errors lie within the predicted bands.

The band of level p about a prediction has the half width z_p sd, where a standard normal variable lies between -z_p and
z_p with probability p: 1.96 sd for 95 %.
"""

from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.types import InputError

LEVELS = tuple(np.round([*np.arange(0.05, 0.95, 0.05), 0.95, 0.975, 0.99], 3).tolist())
"""Levels of a coverage curve."""
LEVEL = 0.95
"""Level of the bands reported as a single number."""


class Coverage(NamedTuple):
    """Shares of samples within the bands, by level and joint."""

    levels: Float[np.ndarray, " n"]
    shares: Float[np.ndarray, "n d"]


def half_width(level: float) -> float:
    """Returns z_p, in standard deviations; raises `InputError` for a level outside (0, 1)."""
    if not 0 < level < 1:
        raise InputError(f"the level of a band is {level}; expected a number between 0 and 1")
    return NormalDist().inv_cdf(0.5 + level / 2)


def coverage(error: Any, std: Any, levels: tuple[float, ...] = LEVELS) -> Coverage:
    """Returns the shares of errors within z_p standard deviations.

    Args:
        error: predicted minus measured, [N, d].
        std: predicted standard deviations, [N, d].
        levels: levels p of the bands.

    Raises:
        InputError: a level is outside (0, 1), or shapes differ.
    """
    error, std = np.asarray(error, np.float64), np.asarray(std, np.float64)
    if error.shape != std.shape or error.ndim != 2 or not len(error):
        raise InputError(f"error is {error.shape} and std {std.shape}; expected the same [N, d] with N >= 1")
    shares = [np.mean(np.abs(error) <= half_width(level) * std, axis=0) for level in levels]
    return Coverage(np.asarray(levels), np.asarray(shares))
