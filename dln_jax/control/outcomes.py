"""What came of many runs: when the pole was up for good, and which ended in no number."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

UP = 0.1
"""rad, within which a pole is up."""


class Outcomes(NamedTuple):
    """Of n runs."""

    seconds: Float[np.ndarray, " n"]
    """From when on the pole is up until the end, s; infinite where it is not."""
    failed: Bool[np.ndarray, " n"]
    """Whether a run ended in no number, which is counted as not up too."""

    @property
    def share(self) -> float:
        """Of runs that are up."""
        return float(np.mean(np.isfinite(self.seconds)))

    @property
    def median(self) -> float:
        """Of the times of those that are up, s; infinite where none is."""
        return self._of_reached(np.median)

    @property
    def worst(self) -> float:
        """Likewise, the longest."""
        return self._of_reached(np.max)

    def _of_reached(self, statistic: Callable[..., Any]) -> float:
        reached = self.seconds[np.isfinite(self.seconds)]
        return float(statistic(reached)) if len(reached) else np.inf


def outcomes(angle: Any, *, rate: float, up: float = UP) -> Outcomes:
    """Of a pole's angles from upright [n, N+1], rad, at the samples of each run.

    An angle that is no number is not up, and neither is whatever follows it.
    """
    angle = np.asarray(angle)
    near = np.cos(angle) > np.cos(up)  # NaN is not
    stays = near.shape[1] - np.argmin(near[:, ::-1], axis=1)
    stays = np.where(near.all(axis=1), 0, stays)
    return Outcomes(np.where(near[:, -1], stays / rate, np.inf), ~np.isfinite(angle).all(axis=1))


def hanging_starts(count: int, seed: int, *, position: float, angle: float = 0.1) -> Float[np.ndarray, "n 4"]:
    """States (position, angle from upright, rates) of a pole that hangs at rest, all but: normal deviations from it.

    Args:
        count: n.
        seed: of the draw.
        position: standard deviation of the driven coordinate, m or rad.
        angle: that of the pole from hanging, rad.
    """
    random = np.random.default_rng(seed)
    x = np.zeros((count, 4))
    x[:, 0] = position * random.normal(size=count)
    x[:, 1] = np.pi + angle * random.normal(size=count)
    return x
