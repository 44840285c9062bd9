"""Time single calls of a trained run in low-latency mode, in a separate process: JAX fixes the mode when it starts.

Reads states from standard input, an npy array [samples, arguments, d], and prints one line of JSON, in microseconds.
"""

import io
import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np

from dln_jax.export.low_latency import enable_low_latency, low_latency
from dln_jax.metrics.latency import one_step
from dln_jax.runs.running import run
from dln_jax.zoo.run import load

ROOT = Path(__file__).parents[2]
"""Folder of the package, for the process to import it."""
LIMIT = 120.0
"""Time limit of the process, s."""
STATES = 512


@dataclass(frozen=True)
class Arguments:
    """Calls to time."""

    run: Path
    """Folder of a run of train_delan or train_hnn."""
    function: Literal["inverse_dynamics", "rates"] = "inverse_dynamics"
    """Function to time, of the dynamics or of the phase field that train_hnn_task trains."""
    calls: int = 5000
    """Number of calls to time."""


def main(options: Arguments) -> None:
    """Times the calls and prints JSON."""
    enable_low_latency()
    states = np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False)
    system = load(options.run).flow if options.function == "rates" else load(options.run).dynamics
    function = low_latency(getattr(system, options.function), *states[0])
    latency = one_step(function, [tuple(map(jnp.asarray, state)) for state in states], calls=options.calls)
    print(json.dumps({key: getattr(latency, key) for key in ("p50_us", "p99_us")}))


def low_latency_metrics(
    folder: Path,
    states: Sequence[np.ndarray],
    say: Callable[[str], None],
    *,
    function: Literal["inverse_dynamics", "rates"] = "inverse_dynamics",
) -> dict[str, float]:
    """Runs `main` in a process and returns its result as metrics; empty if it fails, with the reason passed to `say`.

    `states` are the arguments of the function, [N, d] each.
    """
    command = [sys.executable, "-m", "dln_jax.training.low_latency_calls", "--run", str(folder.resolve())]
    data = io.BytesIO()
    np.save(data, np.stack([array[:STATES] for array in states], axis=1))
    try:
        done = subprocess.run(
            [*command, "--function", function],
            input=data.getvalue(),
            capture_output=True,
            cwd=ROOT,
            # The mode is for the CPU; a second process would compete with the first for a GPU's memory.
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
            timeout=LIMIT,
        )
        if done.returncode:
            raise ValueError(f"exit status {done.returncode}: {last_line(done.stderr)}")
        answer = json.loads(last_line(done.stdout))
        return {f"one_step_low_latency_{key}": float(answer[key]) for key in ("p50_us", "p99_us")}
    except (OSError, subprocess.TimeoutExpired, ValueError, KeyError, TypeError) as error:
        why = f"no answer in {LIMIT:.0f} s" if isinstance(error, subprocess.TimeoutExpired) else str(error)
        say(f"single calls were not timed in low-latency mode ({why})")
        return {}


def last_line(output: bytes) -> str:
    """The last line of a process's output."""
    return next(iter(reversed(output.decode(errors="replace").strip().splitlines())), "it printed nothing")


if __name__ == "__main__":
    run(main, Arguments, prog="python -m dln_jax.training.low_latency_calls")
