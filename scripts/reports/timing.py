"""Timing of programs in turns."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np


def medians_in_turns(
    programs: Mapping[str, Callable[..., Any]],
    arguments: Mapping[str, Callable[[], tuple]] | tuple,
    *,
    repetitions: int,
    warm_up: int = 2,
) -> dict[str, float]:
    """Median wall-clock seconds of compiled programs until their results are ready.

    The programs take turns, so that a slow period of the machine affects all of them.

    Args:
        arguments: those of all programs, or functions that make those of each, which are not timed.
    """
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    for repetition in range(-warm_up, repetitions):
        for name, program in programs.items():
            values = arguments if isinstance(arguments, tuple) else jax.block_until_ready(arguments[name]())
            start = time.perf_counter()
            jax.block_until_ready(program(*values))
            if repetition >= 0:
                seconds[name].append(time.perf_counter() - start)
    return {name: float(np.median(values)) for name, values in seconds.items()}
