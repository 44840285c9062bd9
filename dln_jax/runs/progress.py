"""Live progress: a bar on a terminal, a line every few seconds elsewhere."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

SECONDS_BETWEEN_LINES = 5.0
LATEST = [0.0]
"""Reading of `time.monotonic` at the latest line of progress; infinite while a bar is shown."""
ROOM_FOR_RATE = 110
"""Smallest terminal width, in columns, that has room for the rate beside the count, the time left and the text."""


@contextmanager
def progress(
    total: int, unit: str = "steps", *, console: Console | None = None
) -> Iterator[Callable[[int, str], None]]:
    """Yields `show(done, text)`. Count, text and time left fit in 80 columns; the bar takes the rest of the line."""
    console = console or Console()
    first: list[tuple[int, float]] = []

    def rate(done: int, now: float) -> str:
        """Steps per second since the first call; empty below one."""
        first[:] = first or [(done, now)]
        steps, elapsed = done - first[0][0], now - first[0][1]
        return f"{steps / elapsed:.0f} {unit}/s" if elapsed > 0 and steps >= elapsed else ""

    if console.is_terminal:
        columns = [
            MofNCompleteColumn(),
            BarColumn(bar_width=None),
            TextColumn("{task.fields[left]}"),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.description}"),
        ]
        if console.width >= ROOM_FOR_RATE:
            columns.insert(1, TextColumn("{task.fields[rate]}"))
        with Progress(*columns, console=console, expand=True) as bar:
            task = bar.add_task("compiling", total=total, rate="", left="left")

            def show(done: int, text: str) -> None:
                bar.update(task, completed=done, description=text, rate=rate(done, time.monotonic()))

            LATEST[0] = math.inf
            try:
                yield show
            finally:
                LATEST[0] = time.monotonic()
    else:
        last = [0.0]

        def show_line(done: int, text: str) -> None:
            now = time.monotonic()
            per_second = rate(done, now)
            if done >= total or now - last[0] >= SECONDS_BETWEEN_LINES:
                LATEST[0] = last[0] = now
                print(f"{done}/{total} {unit}  {text}  {per_second}".rstrip(), flush=True)

        yield show_line


@contextmanager
def heartbeat(began: float) -> Iterator[None]:
    """Prints the time since `began` after every few seconds without progress, as in a linear fit or a compilation.

    Args:
        began: reading of `time.perf_counter`.
    """
    LATEST[0] = time.monotonic()
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(1.0):
            if time.monotonic() - LATEST[0] >= SECONDS_BETWEEN_LINES:
                LATEST[0] = time.monotonic()
                with suppress(OSError, ValueError):  # the main thread reports a closed output
                    print(f"still working after {time.perf_counter() - began:.0f} s", flush=True)

    threading.Thread(target=beat, daemon=True).start()
    try:
        yield
    finally:
        ended.set()
