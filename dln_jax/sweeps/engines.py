"""What runs jobs, as functions: an engine starts some, says of each whether it is over, and can end them."""

import importlib
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from dln_jax.sweeps.status import Status, close, end, renew
from dln_jax.types import InputError

SECONDS_BETWEEN_LOOKS = 0.2


class Engine(NamedTuple):
    """What runs jobs; a handle is the engine's own."""

    start: Callable[[Sequence[Path]], Sequence[Any]]
    """Files of jobs -> their handles."""
    over: Callable[[Any], str | None]
    """Handle -> None while the job waits or runs, else the engine's word of its end, which may be empty."""
    stop: Callable[[Sequence[Any]], None]
    """Ends the jobs of these handles, and returns when they have ended."""
    at_once: int
    """Jobs that it is given beside each other."""


def run_all(engine: Engine, paths: Sequence[Path], report: Callable[[int, int], None]) -> None:
    """Runs jobs until all are over; an interrupt ends those that run.

    Args:
        engine: what runs them.
        paths: of the jobs' files.
        report: called with how many are over, and how many of them are not done.
    """
    waiting, running, ended = deque(paths), {}, list[Status]()
    try:
        while waiting or running:
            free = min(engine.at_once - len(running), len(waiting))
            if free > 0:
                batch = [waiting.popleft() for _ in range(free)]
                for path in batch:
                    renew(path.parent)
                running |= zip(batch, engine.start(batch), strict=True)
            time.sleep(SECONDS_BETWEEN_LOOKS)
            for path, handle in list(running.items()):
                if (word := engine.over(handle)) is not None:
                    ended.append(close(path.parent, word))
                    del running[path]
                    report(len(ended), sum(each.state != "done" for each in ended))
    except BaseException:
        engine.stop(list(running.values()))
        for path in running:
            end(path.parent, "interrupted")
        raise


def required(package: str, extra: str) -> ModuleType:
    """An engine's package; `InputError` names the extra that brings it, where it is missing."""
    try:
        return importlib.import_module(package)
    except ImportError:
        raise InputError(f"{package} is not installed; pip install 'dln-jax[{extra}]'") from None
