"""Interrupts, standard streams and time limit of a command's process.

An interrupt prints one word instead of a traceback, and never damages a checkpoint. `--seconds` counts from the start
of the process until the model is stored.
"""

import contextlib
import io
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

SOON = 1e-3
"""Seconds left that are reported after the deadline; a fit needs a positive limit, and then does one dispatch."""
_began: ContextVar[float | None] = ContextVar("began", default=None)


def in_a_word(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Replaces `sys.excepthook`, so that an interrupt during the imports prints no traceback."""
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


def resend_interrupt(unraisable: Any) -> None:
    """Replaces `sys.unraisablehook`: an interrupt within a callback of the garbage collector, which Python drops."""
    if unraisable.exc_type is KeyboardInterrupt:
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(unraisable)


def is_command() -> bool:
    """Whether this process runs `dln-jax`, `python -m dln_jax` or `python -m scripts.NAME`."""
    words = sys.orig_argv
    package, _, name = words[words.index("-m") + 1 :][0].partition(".") if "-m" in words[:-1] else ("", "", "")
    script = package == "scripts" and (Path(__file__).parents[1] / "scripts" / f"{name}.py").is_file()
    return script or (package == "dln_jax" and not name) or Path(sys.argv[0]).stem == "dln-jax"


@contextlib.contextmanager
def held_back() -> Iterator[None]:
    """Delays SIGINT and SIGTERM to the end of the block, such as a training step and its checkpoint.

    Python raises an interrupt only when a compiled program returns, so the block adds only the time of its checkpoint.
    Has no effect outside the main thread, because only the main thread may set signal handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        caught.append(number)

    handlers: dict[int, Any] = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # A handler that is not a Python function, such as SIG_IGN, could not be called below.
    handlers = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in handlers:
        signal.signal(number, note)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if caught:
            handlers[caught[0]](caught[0], None)


def open_standard_streams() -> None:
    """Opens closed standard streams (`>&-`) on the null device, and makes any text printable in any encoding."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            os.dup2(os.open(os.devnull, os.O_RDWR), number)  # keeps the descriptor for it
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115  to the end
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


@contextlib.contextmanager
def counting_from(began: float) -> Iterator[None]:
    """Makes `deadline` count from this reading of `time.perf_counter` within the block."""
    token = _began.set(began)
    try:
        yield
    finally:
        _began.reset(token)


def deadline(seconds: float | None) -> float:
    """Returns the reading of `time.perf_counter` at which the time is up; infinite without a limit.

    Outside a command the seconds count from now.
    """
    began = _began.get()
    return math.inf if seconds is None else seconds + (time.perf_counter() if began is None else began)


def seconds_left(until: float) -> float:
    """Seconds until a deadline, `SOON` if it has passed."""
    return max(until - time.perf_counter(), SOON)


if is_command():
    sys.excepthook, sys.unraisablehook = in_a_word, resend_interrupt
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:  # SIGTERM ends a command as Ctrl-C does
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    open_standard_streams()
