"""Training runs that are killed at random moments and resumed, compared with unbroken runs.

A run starts anew for every kill (SIGKILL, at a random moment between its first checkpoint and its end) and is resumed
to the end. Its model file is compared bit for bit.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from dln_jax.types import InputError, require_positive
from scripts.reports.case import Case, Findings
from scripts.reports.rows import Row

RUNS = {
    "gauss-newton": ("train_delan", "--optimizer", "gauss-newton", "--steps", "60"),
    "adam": ("train_delan", "--optimizer", "adam", "--steps", "4000", "--width", "16"),
    "task": ("train_hnn_task", "--task", "spring", "--steps", "40"),
    "function": ("train_diffnet", "--samples", "6000", "--width", "8"),
    "locomotion": ("train_locomotion", "--start", "0", "--steps", "6000"),
}
"""Script and options of the runs, which are short but store several checkpoints."""
TIMED = ("train_delan", "train_hnn_task")
"""Scripts that would also time calls in another process."""
MODEL = "model.safetensors"
ROOT = Path(__file__).parents[3]
"""Folder of the package that the runs import."""


def cases(names: Sequence[str] = tuple(RUNS), *, kills: int = 10, seed: int = 0) -> list[Case]:
    """One case per run; `seed` sets the moments of the kills; `InputError` for invalid numbers."""
    require_positive(kills=kills)
    random = np.random.default_rng(seed)
    return [Case(name, partial(killed_and_resumed, name, random, kills)) for name in names]


def killed_and_resumed(name: str, random: np.random.Generator, kills: int) -> Findings:
    """Number of resumed runs identical to the unbroken one."""
    with tempfile.TemporaryDirectory() as place:
        same, moments = interrupted(RUNS[name], Path(place), random, kills=kills)
    shown = ", ".join(f"{moment:.2f}" for moment in moments)
    words = f"as the unbroken run; killed s after a checkpoint: {shown}"
    return Findings([Row(name, "resumed_bit_for_bit", same, "runs", bound=kills, at_least=True, expected=words)])


def interrupted(
    command: Sequence[str], place: Path, random: np.random.Generator, *, kills: int
) -> tuple[int, list[float]]:
    """Number of `kills` interrupted runs that end as the unbroken one, and the kills' times, s after a checkpoint."""
    # Twice: the second run finds the compiled programs of the first, as the killed runs do.
    for name in ("first", "unbroken"):
        length = lasted(start(command, place, name), place / name)
    expected = (place / "unbroken" / MODEL).read_bytes()
    if (place / "first" / MODEL).read_bytes() != expected:
        raise InputError(f"{' '.join(command)}: two unbroken runs differ; there is nothing to compare with")
    same, moments = 0, []
    while len(moments) < kills:
        name = f"killed-{len(moments)}"
        moment = float(random.uniform(0, length))
        if not killed(start(command, place, name), place / name, moment):
            # The run ended before the kill; nothing was interrupted.
            length *= 0.9
            (place / name).rename(place / f"over-{time.monotonic_ns()}")
            continue
        moments.append(moment)
        finished(start(command, place, name, "--resume"), place / name)
        same += (place / name / MODEL).read_bytes() == expected
    return same, moments


def start(command: Sequence[str], place: Path, name: str, *others: str) -> subprocess.Popen[str]:
    """A run in a process of its own; runs of one place share compiled programs."""
    script, *options = command
    settings = options if "--resume" not in others else []
    left_out = ["--no-figures", *(["--no-low-latency"] if script in TIMED else [])]
    return subprocess.Popen(
        [sys.executable, "-m", "dln_jax", script, *settings, *left_out, "--out", str(place / name), *others],
        cwd=ROOT,
        env={**os.environ, "JAX_COMPILATION_CACHE_DIR": str(place / "programs")},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def lasted(process: subprocess.Popen[str], folder: Path) -> float:
    """Seconds from a run's first checkpoint to its model."""
    wait_for(process, folder, "checkpoint*.json")
    began = time.monotonic()
    wait_for(process, folder, MODEL)
    length = time.monotonic() - began
    finished(process, folder)
    return length


def killed(process: subprocess.Popen[str], folder: Path, moment: float) -> bool:
    """Kills a run `moment` seconds after its first checkpoint; returns whether it had no model yet."""
    wait_for(process, folder, "checkpoint*.json")
    time.sleep(moment)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    return not (folder / MODEL).exists()


def wait_for(process: subprocess.Popen[str], folder: Path, pattern: str) -> None:
    """Waits until a run has written a file of this name; `InputError` if it fails before."""
    while not any(folder.glob(pattern)):
        if process.poll() is not None:
            finished(process, folder)
            return
        time.sleep(0.005)


def finished(process: subprocess.Popen[str], folder: Path) -> None:
    """Waits for the end of a run; `InputError` if it failed."""
    errors = process.communicate()[1]
    if process.returncode:
        raise InputError(f"the run in {folder} failed: {errors.strip()[-200:]}")
