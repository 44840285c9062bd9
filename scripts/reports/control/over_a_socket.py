"""Swing-up in real time of a rotary pendulum in another process, which is reached over a socket, from 30 s of data."""

import math
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import IO

import numpy as np

from dln_jax.control.plants import Plant, compiled, hardware_plant, judged_runs, layout, run, start_of
from dln_jax.training.swing_ups.any_plant import SECONDS, learn_to_swing_up
from scripts.reports.case import Findings
from scripts.reports.control import rig
from scripts.reports.process import ROOT
from scripts.reports.rows import Row

RATE = 100.0
STARTS, TO_REACH = 10, 0.99
ROTARY = layout(
    ("revolute", "revolute"), [0], goal=(0, 0), hanging=(0, np.pi), rate=RATE, control=rig.LARGEST,
    position=[[-2.5, 2.5], [-np.inf, np.inf]], speed=(40.0, 60.0),
)  # fmt: skip
STILL, SLOW, NEAR = 50, 0.01, 0.3
"""Number of still samples before a start; largest change of an angle and distance from hanging in them, rad."""


def plant_over(lines: IO[str]) -> Plant:
    """Returns the plant behind a connection: all that a user has to write."""

    def read() -> np.ndarray:
        print("q", file=lines, flush=True)
        return np.array(lines.readline().split(), float)

    def write(u: np.ndarray) -> None:
        print("u", float(u[0]), file=lines, flush=True)

    def reset() -> None:
        before, still = read(), 0
        while still < STILL:
            time.sleep(1 / RATE)
            q = read()
            moved, away = (np.remainder(q - other + np.pi, 2 * np.pi) - np.pi for other in (before, ROTARY.hanging))
            write(np.clip(-0.01 * q[:1] - 0.2 * moved[:1], -0.02, 0.02))
            still = still + 1 if np.abs(moved).max() < SLOW and np.abs(away).max() < NEAR else 0
            before = q
        write(np.zeros(1))

    return hardware_plant(ROTARY, reset=reset, read=read, write=write)


@contextmanager
def connected(seed: int) -> Iterator[IO[str]]:
    """Starts a rig, and yields the connection to it."""
    command = [sys.executable, "-m", rig.__name__, str(seed)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            with socket.create_connection(("127.0.0.1", int(process.stdout.readline()))) as connection:
                # Or TCP holds a short message back until the one before is acknowledged, for up to 40 ms.
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                with connection.makefile("rw") as lines:
                    yield lines
        finally:
            process.terminate()


def in_real_time(seed: int, quick: bool = False, *, say: Callable[[str], None] = lambda _: None) -> Findings:
    """Explores, learns, tunes and tries the rig."""
    with connected(seed) as lines:
        return learned_and_tried(plant_over(lines), f"rig/over-a-socket-{seed}", seed, 3 if quick else STARTS, say=say)


def learned_and_tried(
    plant: Plant, case: str, seed: int, starts: int, *, say: Callable[[str], None] = lambda _: None
) -> Findings:
    """Explores, learns, tunes and tries a plant that has the rig's pendulum."""
    learned = learn_to_swing_up(plant, seed=seed, say=say)
    controller = learned.tuned.controller
    act, memory = compiled(controller, plant.layout), start_of(controller, 1)
    runs = [run([plant], act, memory, seconds=SECONDS)[0] for _ in range(starts)]
    trials = judged_runs(runs, plant.layout, seconds=SECONDS)
    seconds, words = trials.seconds[trials.up], f"of {starts} starts up within {SECONDS:g} s; 30 s of data"
    return Findings(
        [
            Row(case, "success_share", float(trials.up.mean()), bound=TO_REACH, at_least=True, expected=words),
            Row(case, "seconds_median", float(np.median(seconds)) if len(seconds) else math.inf, "s"),
            Row(case, "stopped", float(len(trials.stopped))),
            Row(case, "delay", learned.prepared.delay, "samples", expected="1 and the time of our answers"),
            Row(case, "tuning_margin", learned.tuned.margin),
        ]
    )


CASES: dict[str, Callable[[bool], Findings]] = {
    f"rig/over-a-socket-{seed}": partial(in_real_time, seed) for seed in (0, 1, 2)
}
"""Cases of the control report by the seed of the noise."""
