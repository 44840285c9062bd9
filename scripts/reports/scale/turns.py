"""The same work by one device, several devices and several processes, interleaved so that slow spells affect all."""

import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import IO, Any, NamedTuple

import numpy as np

from dln_jax.types import InputError
from scripts.reports.process import search_path


class Layout(NamedTuple):
    """Who shares the work."""

    devices: int = 1
    """Devices per process."""
    processes: int = 1
    platform: str = "cpu"
    """JAX's name of the platform; empty for JAX's default."""


class Measured(NamedTuple):
    """Measurement of one layout."""

    seconds: float
    """Time of the slowest process, median over turns."""
    processors: float
    """Average number of busy cores: processor seconds of all processes per second."""
    facts: dict[str, Any]
    """Facts that the work reports."""


Team = Callable[[Any], list[dict[str, Any]]]
"""A question to all processes of a layout -> the answer of each."""


@contextlib.contextmanager
def team(layout: Layout) -> Iterator[tuple[Team, dict[str, Any]]]:
    """Starts the processes of a layout; yields a function to question them, and the first process's device facts.

    Raises:
        InputError: a process ended instead of answering.
    """
    command = [sys.executable, "-m", "scripts.reports.scale.worker", str(layout.devices), str(layout.processes)]
    environment = {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false", "PYTHONPATH": search_path()}
    environment |= {"JAX_PLATFORMS": layout.platform} if layout.platform else {}
    port = str(_free_port())
    with contextlib.ExitStack() as stack:
        errors = [stack.enter_context(tempfile.TemporaryFile()) for _ in range(layout.processes)]
        workers = [
            stack.enter_context(_worker([*command, str(number), port], environment, error))
            for number, error in enumerate(errors)
        ]

        def ask(question: Any) -> list[dict[str, Any]]:
            for worker, error in zip(workers, errors, strict=True):
                try:
                    print(json.dumps(question), file=worker.stdin, flush=True)
                except BrokenPipeError:
                    raise _silent(error) from None
            return answers()

        def answers() -> list[dict[str, Any]]:
            return [_answer(worker, error) for worker, error in zip(workers, errors, strict=True)]

        yield ask, answers()[0]


def taken_in_turns(teams: Mapping[str, Team], work: Mapping[str, Any], repetitions: int) -> dict[str, Measured]:
    """Measures some work on all teams in turns."""
    facts = {name: ask(work)[0] for name, ask in teams.items()}
    turns: dict[str, list[tuple[float, float]]] = {name: [] for name in teams}
    for _ in range(repetitions + 1):
        for name, ask in teams.items():
            answers = ask(None)
            seconds = max(answer["seconds"] for answer in answers)
            turns[name].append((seconds, sum(answer["processor_seconds"] for answer in answers) / seconds))
    # The first turn warms up.
    medians = {name: np.median(pairs[1:], axis=0) for name, pairs in turns.items()}
    return {name: Measured(float(medians[name][0]), float(medians[name][1]), facts[name]) for name in teams}


def teams_of(stack: contextlib.ExitStack, layouts: Mapping[str, Layout]) -> dict[str, Team]:
    """The teams of some layouts, for as long as the stack is open."""
    return {name: stack.enter_context(team(layout))[0] for name, layout in layouts.items()}


@contextlib.contextmanager
def _worker(
    command: Sequence[str], environment: Mapping[str, str], error: IO[bytes]
) -> Iterator[subprocess.Popen[str]]:
    pipe = subprocess.PIPE
    worker = subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, stderr=error, text=True)
    try:
        yield worker
    finally:
        # A process that waits for a peer which has ended would not notice that its input is closed.
        worker.kill()
        worker.communicate()


def _answer(worker: subprocess.Popen[str], error: IO[bytes]) -> dict[str, Any]:
    line = worker.stdout.readline() if worker.stdout else ""
    if not line:
        raise _silent(error)
    return json.loads(line)


def _silent(error: IO[bytes]) -> InputError:
    error.seek(0)
    lines = error.read().decode(errors="replace").strip().splitlines() or ["it printed nothing"]
    return InputError(f"a process that was to be measured ended: {lines[-1]}")


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]
