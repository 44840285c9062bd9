"""Live progress: a bar on a terminal, a line now and then elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

SECONDS_BETWEEN_LINES = 5.0


@contextmanager
def progress(total: int, unit: str = "steps") -> Iterator[Callable[[int, str], None]]:
    """Yields `show(done, text)`; the bar adds rate and time left."""
    if sys.stdout.isatty():
        columns = (
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
        )
        with Progress(*columns, console=Console()) as bar:
            task = bar.add_task("compiling", total=total, rate="")
            first: list[tuple[int, float]] = []

            def show(done: int, text: str) -> None:
                first.append((done, time.monotonic())) if not first else None
                bar.update(task, completed=done, description=text, rate=_rate(first[0], done, unit))

            yield show
    else:
        first, last = [], [0.0]

        def show_line(done: int, text: str) -> None:
            now = time.monotonic()
            first.append((done, now)) if not first else None
            if done >= total or now - last[0] >= SECONDS_BETWEEN_LINES:
                last[0] = now
                print(f"{done}/{total} {unit}  {text}  {_rate(first[0], done, unit)}", flush=True)

        yield show_line


def _rate(first: tuple[int, float], done: int, unit: str) -> str:
    elapsed = time.monotonic() - first[1]
    return f"{(done - first[0]) / elapsed:.0f} {unit}/s" if elapsed > 0 and done > first[0] else ""
