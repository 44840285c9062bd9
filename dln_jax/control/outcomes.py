"""Outcomes of many runs: the time at which the pole stays upright, and runs that failed."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

UP = 0.1
"""Angle in rad below which a pole counts as upright."""


class Outcomes(NamedTuple):
    """Outcomes of n runs."""

    seconds: Float[np.ndarray, " n"]
    """Time in s after which the pole stays upright until the end; infinite if it does not."""
    failed: Bool[np.ndarray, " n"]
    """Whether a run contains values that are not finite; such values do not count as upright."""

    @property
    def share(self) -> float:
        """Share of the runs that end upright."""
        return float(np.mean(np.isfinite(self.seconds)))

    @property
    def median(self) -> float:
        """Median time of the runs that end upright, s; infinite if none does."""
        return self._of_reached(np.median)

    @property
    def worst(self) -> float:
        """Longest time of the runs that end upright, s; infinite if none does."""
        return self._of_reached(np.max)

    def _of_reached(self, statistic: Callable[..., Any]) -> float:
        reached = self.seconds[np.isfinite(self.seconds)]
        return float(statistic(reached)) if len(reached) else np.inf


def outcomes(angle: Any, *, rate: float, up: float = UP) -> Outcomes:
    """Evaluates a pole's angles from upright [n, N+1], rad, at the samples of the runs.

    An angle that is not finite does not count as upright.
    """
    angle = np.asarray(angle)
    near = np.cos(angle) > np.cos(up)  # NaN is not
    stays = near.shape[1] - np.argmin(near[:, ::-1], axis=1)
    stays = np.where(near.all(axis=1), 0, stays)
    return Outcomes(np.where(near[:, -1], stays / rate, np.inf), ~np.isfinite(angle).all(axis=1))


def hanging_starts(count: int, seed: int, *, position: float, angle: float = 0.1) -> Float[np.ndarray, "n 4"]:
    """Random states (position, angle from upright, rates) near a pole hanging at rest, with normal deviations.

    Args:
        count: n.
        seed: of the draw.
        position: standard deviation of the driven coordinate, m or rad.
        angle: standard deviation of the pole from hanging, rad.
    """
    random = np.random.default_rng(seed)
    x = np.zeros((count, 4))
    x[:, 0] = position * random.normal(size=count)
    x[:, 1] = np.pi + angle * random.normal(size=count)
    return x
