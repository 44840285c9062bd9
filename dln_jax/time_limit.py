"""A command's limit of time: `--seconds` counts from the start of its process until the model is stored."""

import contextlib
import math
import time
from collections.abc import Iterator
from contextvars import ContextVar

IMPORTED = time.perf_counter()
"""When this package was imported, which is about when a command's process started."""
SOON = 1e-3
"""Seconds that count as left when the time is over: a fit needs a positive number, and then does one dispatch."""
_began: ContextVar[float | None] = ContextVar("began", default=None)


@contextlib.contextmanager
def counting_from(began: float) -> Iterator[None]:
    """Lets the deadlines of a command count from this reading of `time.perf_counter`."""
    token = _began.set(began)
    try:
        yield
    finally:
        _began.reset(token)


def deadline(seconds: float | None) -> float:
    """The reading of `time.perf_counter` at which a command's seconds are over; infinite without a limit.

    Outside of a command the seconds count from now.
    """
    began = _began.get()
    return math.inf if seconds is None else seconds + (time.perf_counter() if began is None else began)


def seconds_left(until: float) -> float:
    """Seconds until a deadline, `SOON` if it has passed."""
    return max(until - time.perf_counter(), SOON)
