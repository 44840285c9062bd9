"""Timing of single calls, as in a control loop."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.zoo.run import Run

WARM_UP = 200
"""Untimed calls before the measurement; the first compiles."""


class Latency(NamedTuple):
    """Percentiles of the wall-clock time of one call, until its result is ready and without compilation."""

    p50_us: float
    p99_us: float


def one_step(function: Callable, states: Sequence[tuple], *, calls: int = 5000) -> Latency:
    """Times calls of a compiled function, one state at a time, cycling through the states.

    The function is jitted, or takes NumPy arrays, and is called as `function(*state)`. All states have the same shape
    but different values, so that no result comes from a cache.
    """
    nanoseconds = np.empty(WARM_UP + calls)
    for index in range(WARM_UP + calls):
        state = states[index % len(states)]
        start = time.perf_counter_ns()
        jax.block_until_ready(function(*state))
        nanoseconds[index] = time.perf_counter_ns() - start
    return Latency(*np.percentile(nanoseconds[WARM_UP:] / 1e3, [50, 99]).tolist())


def latency_of(run: Run, data: Trajectories, *, calls: int = 5000) -> Latency:
    """Measures the latency of a model's inverse dynamics on up to 512 states of the data."""
    dtype = run.dtype
    arrays = (np.asarray(array[:512], dtype) for array in (data.q, data.qd, data.qdd))
    states = [tuple(map(jnp.asarray, state)) for state in zip(*arrays, strict=True)]  # NumPy's rows: no compiled slices
    return one_step(run.dynamics.inverse_dynamics, states, calls=calls)
