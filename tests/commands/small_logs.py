"""Logs that say nothing, for what is refused before it is learned."""

import numpy as np

STATES = ("q", "qd", "qdd", "tau")


def small_log(d, trajectories=5, samples=4):
    """Arrays of short trajectories of random numbers."""
    states = np.random.default_rng(0).normal(size=(4, trajectories * samples, d))
    times = {"t": np.tile(np.arange(samples), trajectories), "trajectory": np.repeat(np.arange(trajectories), samples)}
    return times | dict(zip(STATES, states, strict=True))
