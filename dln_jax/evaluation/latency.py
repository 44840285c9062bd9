"""How long one call takes, as a caller in a control loop would see it."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np


class Latency(NamedTuple):
    """Wall-clock time of single calls, results waited for, compilation apart."""

    compile_seconds: float
    p50_us: float
    p99_us: float
    calls: int


def one_step(function: Callable, states: Sequence[tuple], *, calls: int = 5000, warm_up: int = 200) -> Latency:
    """Times calls of a compiled function, one state at a time, going round the given states.

    Args:
        function: a jitted function; called as `function(*state)`.
        states: argument tuples of one shape; varied, so that nothing is answered from a cache.
        calls: calls that are timed.
        warm_up: calls before them.
    """
    start = time.perf_counter()
    jax.block_until_ready(function(*states[0]))
    compile_seconds = time.perf_counter() - start
    for index in range(warm_up):
        jax.block_until_ready(function(*states[index % len(states)]))
    nanoseconds = np.empty(calls)
    for index in range(calls):
        state = states[index % len(states)]
        start = time.perf_counter_ns()
        jax.block_until_ready(function(*state))
        nanoseconds[index] = time.perf_counter_ns() - start
    p50, p99 = np.percentile(nanoseconds / 1e3, [50, 99])
    return Latency(compile_seconds, float(p50), float(p99), calls)
