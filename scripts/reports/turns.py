"""Timing of whole programs in turns."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np


def medians_in_turns(
    programs: Mapping[str, Callable[..., Any]], arguments: tuple, *, repetitions: int, warm_up: int = 2
) -> dict[str, float]:
    """Median wall-clock seconds of compiled programs on the same arguments, until their results are ready.

    The programs take turns, so that a slow period of the machine affects all of them.
    """
    seconds = {name: np.empty(repetitions) for name in programs}
    for repetition in range(-warm_up, repetitions):
        for name, program in programs.items():
            start = time.perf_counter()
            jax.block_until_ready(program(*arguments))
            if repetition >= 0:
                seconds[name][repetition] = time.perf_counter() - start
    return {name: float(np.median(values)) for name, values in seconds.items()}
