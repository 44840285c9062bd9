"""Checks the sampling times of a log and its number of trajectories."""

import numpy as np

from dln_jax.data.checks.findings import Finding
from dln_jax.data.encoders import sampling
from dln_jax.data.schema import Trajectories

JITTER = 0.05
"""Largest standard deviation of the steps, relative to the step."""
SLOWEST = 1.0
"""Hz: at a lower rate t is hardly in seconds."""
UNEQUAL = 0.2
"""Largest relative difference between the rates of trajectories."""
FEWEST = 3
"""Fewest trajectories for training, validation and test."""
FILTER = "interpolate to equal steps with smooth() or --cutoff auto"


def check_times(data: Trajectories) -> list[Finding]:
    """Checks rate, jitter, gaps and the number of trajectories for a split."""
    found = []
    counts = np.unique(data.trajectory, return_counts=True)[1]
    if len(counts) < FEWEST:
        said = f"there are {len(counts)} trajectories, and a split by trajectory takes {FEWEST}"
        found.append(Finding("warning", "split", said, "record more, or cut the log in time and index the parts"))
    if counts.max() < 2:
        return found
    timing = sampling.timing(data.t, data.trajectory)
    if timing.rate < SLOWEST:
        said = f"a sample every {1 / timing.rate:.3g} s"
        found.append(Finding("error", "time-unit", said, "give t in seconds if it is in milliseconds or ticks"))
    if timing.gaps:
        said = f"{timing.gaps} gap(s) in time, the longest step {timing.longest:.3g} s of {1 / timing.rate:.3g} s"
        found.append(Finding("note", "gaps", said, "rates across them are guesses: cut there, smooth() does"))
    if timing.jitter > JITTER:
        said = f"time steps vary by {timing.jitter:.0%}"
        found.append(Finding("warning", "jitter", said, FILTER))
    if np.ptp(timing.rates) > UNEQUAL * timing.rate:
        said = f"trajectories are sampled at {timing.rates.min():.4g} to {timing.rates.max():.4g} Hz"
        found.append(Finding("note", "rates", said, FILTER))
    return found
