"""Processes watch each other, and a run ends in all of them, in a line, when one is gone or stuck.

Process 0 looks at all others, and they at process 0, which says what it has seen: n processes read 2 n files a beat.
"""

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from dln_jax.scale.meeting import peers_of
from dln_jax.scale.places import Place
from dln_jax.scale.signs import Limits, Peer, Sign, has_left, looked_at, remove, require_own, write
from dln_jax.scale.worker import End, Worker, ended, heard, spawn

LOST = 3
"""Exit status where another process is lost."""


class Verdict(NamedTuple):
    """How a run ends."""

    code: int
    """Exit status."""
    said: str = ""
    own: bool = False
    """Whether it is this process's own end."""


def watched(work: Callable[[], None], place: Place, folder: Path, own: Sign, limits: Limits, remedy: str) -> int:
    """Does `work` in a child, beside the other processes, and gives the exit status.

    Args:
        work: what all processes do.
        place: this process among them.
        folder: where they see each other.
        own: this process's last sign.
        limits: after which times what happens.
        remedy: what a user should do when a process was lost.

    Raises:
        InputError: another process was started as this one.
    """
    worker, verdict = spawn(work, limits.beat), None
    others, last, waited = peers_of(place), time.monotonic(), 0.0
    try:
        with _signals(worker.pid) as told:
            while verdict is None:
                now = time.monotonic()
                seconds, last = min(now - last, 2 * limits.beat), now
                beats = worker.beats
                worker = heard(worker, limits.beat / 2, seconds)
                end = worker.end or _stuck(worker, limits) or (told[0] if told else None)
                worker = worker._replace(end=end)
                if end or worker.beats != beats:
                    require_own(folder, place.process, own.token)
                    own = _next(own, worker)
                    write(folder, place.process, own)
                others = {k: looked_at(peer, folder, k, seconds) for k, peer in others.items()}
                trouble = _trouble(others, worker.joined, limits)
                waited = waited + seconds if trouble or end else 0.0
                verdict = _judged(place, own, end, others, trouble, waited, limits)
    finally:
        ended(worker)
    _tell(worker.end, verdict, remedy)
    if place.process == 0:
        code = verdict.code if verdict.code == 0 or (verdict.code == 2 and not worker.joined) else LOST
        over = own._replace(stage="over", code=code, said=verdict.said)
        _leave_last(folder, over, others, limits)
    elif others[0].silent > limits.silent:
        remove(folder, 0)
    return verdict.code


def _next(own: Sign, worker: Worker) -> Sign:
    """What is to be said of the child."""
    own = own._replace(beat=own.beat + 1)
    if worker.end and not worker.end.cut_off:
        return own._replace(stage="ended", code=worker.end.code, said=worker.end.said)
    return own._replace(stage="joined" if worker.joined else "met")


def _stuck(worker: Worker, limits: Limits) -> End | None:
    if worker.silent > limits.silent:
        return End(LOST, f"no sign of life for {limits.silent:g} s (stopped)", shown=False)
    if worker.idle > limits.idle:
        return End(LOST, f"no progress for {limits.idle:g} s (stuck, or it waits for one that is)", shown=False)
    return None


def _trouble(others: Mapping[int, Peer], joined: bool, limits: Limits) -> Verdict | None:
    """What has become of the first of them that is lost, `None` where none is."""
    for k, (sign, _, silent) in others.items():
        host = sign.host if sign else "?"
        if sign and k and sign.stage == "ended" and sign.code:
            refused = sign.code == 2 and not joined
            return Verdict(2 if refused else LOST, f"process {k} on {host}: {sign.said}")
        if silent > limits.silent:
            why = f"no sign of life for {limits.silent:g} s (killed, stopped or cut off)"
            return Verdict(LOST, f"process {k} on {host}: {why}")
    return None


def _judged(
    place: Place,
    own: Sign,
    end: End | None,
    others: Mapping[int, Peer],
    trouble: Verdict | None,
    waited: float,
    limits: Limits,
) -> Verdict | None:
    """How the run ends, `None` while it does not; `waited` is the time for which there has been an end or trouble."""
    lost = Verdict(LOST, f"process {place.process} on {own.host}: lost the connection to the others", own=True)
    if end is None or end.cut_off:
        first = others.get(0)
        if first and first.sign and first.sign.stage == "over":
            return Verdict(first.sign.code, first.sign.said)
        if trouble and waited > limits.grace:
            return trouble
        return lost if end and waited > limits.silent + 3 * limits.grace else None
    mine = Verdict(end.code, f"process {place.process} on {own.host}: {end.said}" if end.code else "", own=True)
    if place.process:
        sign = others[0].sign
        if sign and sign.stage == "over":
            return mine if end.code else Verdict(sign.code, sign.said)
        if trouble and not end.code:
            return trouble
        return mine if end.code and waited > 2 * limits.grace else None
    done = all(peer.silent > limits.silent or (peer.sign and peer.sign.stage == "ended") for peer in others.values())
    return mine if done or (end.code and waited > limits.grace) else None


def _tell(end: End | None, verdict: Verdict, remedy: str) -> None:
    """Tells the user what the child has not."""
    if end and end.shown and end.code:
        return
    if end and end.more and verdict.own:
        print(end.more.rstrip(), file=sys.stderr)
    if verdict.said:
        after = "" if verdict.code == 2 else f"; all processes have ended, {remedy}"
        print(f"error: {verdict.said}{after}", file=sys.stderr, flush=True)


def _leave_last(folder: Path, over: Sign, others: Mapping[int, Peer], limits: Limits) -> None:
    """Says how the run ended until the others have read it, which then remove their files, and removes what is left."""
    while any(peer.silent <= limits.silent and not has_left(folder, k) for k, peer in others.items()):
        over = over._replace(beat=over.beat + 1)
        write(folder, 0, over)
        time.sleep(limits.beat / 2)
        others = {k: looked_at(peer, folder, k, limits.beat / 2) for k, peer in others.items()}
    for k in others:
        remove(folder, k)


@contextmanager
def _signals(child: int) -> Iterator[list[End]]:
    """An interrupt is the child's, which ends as it would have alone; of a request to end the others are told."""
    told: list[End] = []

    def end(number: int, _: object) -> None:
        told.append(End(128 + number, f"ended by {signal.Signals(number).name}", shown=False))

    def hand_on(number: int, _: object) -> None:
        os.kill(child, number)

    handlers = {signal.SIGTERM: end, signal.SIGINT: hand_on}
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield told
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
