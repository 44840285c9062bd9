"""A process does its work in a child of its own, which it can watch and end whatever that is stuck in.

The collectives of JAX have no time limit, and its runtime aborts with a trace of C++ when another process is gone:
neither can be turned into a line and an exit status from inside. The child says over a pipe that it is alive, how far
it is, and how it ended, and stays until its parent ends it: an interpreter that hangs at its exit holds nobody up.
"""

import contextlib
import json
import os
import re
import select
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, NoReturn

_OF_RUNTIME = re.compile(rb"^[WEF]\d{4} .*(coordination|preemption|distributed service)")
"""Lines by which JAX's runtime reports that another process is gone."""
_BETWEEN_PROCESSES = re.compile(r"gloo|nccl|coordination|unavailable|deadline_exceeded", re.IGNORECASE)
_here: dict[str, int] = {"joined": 0, "loops": 0, "progress": 0}
"""Of this process, if it is a child."""


class End(NamedTuple):
    """How a child's work ended."""

    code: int
    """Exit status."""
    said: str = ""
    cut_off: bool = False
    """Whether it may be the end of another process that ended it."""
    shown: bool = True
    """Whether the child has told the user itself."""
    more: str = ""
    """A trace, or what the runtime said."""


class Worker(NamedTuple):
    """A child process, as its parent knows it."""

    pid: int
    messages: int
    """Pipe over which it says how it is."""
    chatter: int
    """Pipe for what is written to its standard error past Python."""
    unread: bytes = b""
    held: bytes = b""
    """Chatter that is shown only if no other process explains it."""
    beats: int = 0
    joined: bool = False
    progress: int | None = None
    """A count, while it is reported."""
    silent: float = 0.0
    """Time without a beat, in s."""
    idle: float = 0.0
    """Time without progress while it is reported, in s."""
    end: End | None = None


def progressed() -> None:
    """Says that a loop of this process has come further."""
    _here["progress"] += 1


@contextlib.contextmanager
def reporting() -> Iterator[None]:
    """Within it `progressed` is called now and then; a process that no longer does is taken for stuck."""
    _here["loops"] += 1
    progressed()
    try:
        yield
    finally:
        _here["loops"] -= 1


def say_joined() -> None:
    """Says that this process is part of the program."""
    _here["joined"] = 1


def spawn(work: Callable[[], None], beat: float) -> Worker:
    """Starts `work` in a child, and gives it to the parent; its end is a return or an exception, as of a process."""
    sys.stdout.flush()
    sys.stderr.flush()
    (messages, say), (chatter, noise) = os.pipe(), os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.close(messages)
            os.close(chatter)
            _be_child(work, say, noise, beat)
        finally:
            os._exit(70)  # only where the lines above are wrong
    for mine, others in ((messages, say), (chatter, noise)):
        os.close(others)
        os.set_blocking(mine, False)
    return Worker(pid, messages, chatter)


def heard(worker: Worker, wait: float, seconds: float) -> Worker:
    """The child after what it says within `wait` s, `seconds` after it was last listened to."""
    select.select([worker.messages, worker.chatter], [], [], wait)
    gone = worker.pid and os.waitpid(worker.pid, os.WNOHANG)
    before, worker = worker, _with_chatter(worker, _available(worker.chatter))
    *lines, unread = (worker.unread + _available(worker.messages)).split(b"\n")
    worker = worker._replace(unread=unread)
    for line in lines:
        told = json.loads(line)
        if "end" in told:
            told = {
                "end": worker.end or End(*told["end"])
            }  # the first one is its own, and may be the cause of the next
        worker = worker._replace(**told)
    silent = 0.0 if worker.beats != before.beats else before.silent + seconds
    stuck = worker.progress is not None and worker.progress == before.progress
    worker = worker._replace(silent=silent, idle=before.idle + seconds if stuck else 0.0)
    if gone and gone[0]:
        worker = worker._replace(pid=0, end=worker.end or _died(os.waitstatus_to_exitcode(gone[1]), worker.held))
    return worker


def ended(worker: Worker) -> None:
    """Ends the child, whatever it does."""
    if worker.pid:
        os.kill(worker.pid, signal.SIGKILL)
        os.waitpid(worker.pid, 0)
    os.close(worker.messages)
    os.close(worker.chatter)


def _died(code: int, held: bytes) -> End:
    """The end of a child that has not told it."""
    if code >= 0:
        return End(3, f"left with exit status {code}", shown=False, more=held.decode(errors="replace"))
    name = signal.Signals(-code).name
    by_runtime = -code == signal.SIGABRT
    return End(3, f"ended by {name}", cut_off=by_runtime, shown=False, more=held.decode(errors="replace"))


def _with_chatter(worker: Worker, text: bytes) -> Worker:
    """Shows chatter until the first line that may be another process's fault; the rest is held."""
    held = worker.held
    for line in text.splitlines(keepends=True):
        if held or _OF_RUNTIME.match(line):
            held += line
        else:
            os.write(2, line)
    return worker._replace(held=held)


def _available(pipe: int) -> bytes:
    with contextlib.suppress(BlockingIOError):
        return os.read(pipe, 2**20)
    return b""


def _be_child(work: Callable[[], None], say: int, noise: int, beat: float) -> NoReturn:
    """The child's life."""
    os.setpgid(0, 0)  # an interrupt from the terminal is the parent's, which hands it on: one is enough
    lock = threading.Lock()

    def tell(**what: Any) -> None:
        with lock:
            os.write(say, json.dumps(what).encode() + b"\n")

    def beats() -> None:
        for count in range(1, sys.maxsize):
            try:
                progress = _here["progress"] if _here["loops"] else None
                tell(beats=count, joined=bool(_here["joined"]), progress=progress)
            except OSError:  # the parent is gone, and nobody else ends this process
                os._exit(3)
            time.sleep(beat)

    _with_own_streams(noise)
    threading.Thread(target=beats, daemon=True).start()
    end = _end_of(work)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tell(end=end)
    while True:
        time.sleep(3600)


def _with_own_streams(noise: int) -> None:
    """Python's streams stay the user's; what libraries print past Python is dropped, or goes to the parent."""
    for name, number in (("stdout", 1), ("stderr", 2)):
        stream = getattr(sys, name)
        text = open(os.dup(number), "w", buffering=1, encoding=stream.encoding, errors=stream.errors)  # noqa: SIM115
        setattr(sys, name, text)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(noise, 2)


def _end_of(work: Callable[[], None]) -> End:
    try:
        work()
        end = End(0)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        reason = stop.__cause__ or stop.__context__
        said = "interrupted" if isinstance(reason, KeyboardInterrupt) else _line(reason or stop)
        end = End(code, said)
    except KeyboardInterrupt:
        end = End(130, "interrupted", shown=False)
    except BaseException as error:
        text = f"{type(error).__name__}: {_line(error)}"
        end = End(1, text, bool(_BETWEEN_PROCESSES.search(text)), shown=False, more=traceback.format_exc())
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    return end


def _line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:500]
