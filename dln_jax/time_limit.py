"""Time limit of a command: `--seconds` counts from the start of its process until the model is stored."""

import contextlib
import math
import time
from collections.abc import Iterator
from contextvars import ContextVar

IMPORTED = time.perf_counter()
"""Time of this package's import, which is close to the start of a command's process."""
SOON = 1e-3
"""Seconds that count as left after the deadline: a fit needs a positive number, and then does one dispatch."""
_began: ContextVar[float | None] = ContextVar("began", default=None)


@contextlib.contextmanager
def counting_from(began: float) -> Iterator[None]:
    """Counts the deadlines of a command from this reading of `time.perf_counter`."""
    token = _began.set(began)
    try:
        yield
    finally:
        _began.reset(token)


def deadline(seconds: float | None) -> float:
    """The reading of `time.perf_counter` at which the time is up; infinite without a limit.

    Outside a command the seconds count from now.
    """
    began = _began.get()
    return math.inf if seconds is None else seconds + (time.perf_counter() if began is None else began)


def seconds_left(until: float) -> float:
    """Seconds until a deadline, `SOON` if it has passed."""
    return max(until - time.perf_counter(), SOON)
