"""Time single calls of trained runs in a process of its own, since how JAX dispatches is settled when it starts.

benchmark one-step starts it twice; it prints one line of JSON: microseconds by run, call path and function.
"""

import json
import re
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.command_line.running import run
from dln_jax.deploy.c.load import FLAGS, WARNINGS, CDynamics, compile_c, load_c
from dln_jax.deploy.c.source import export_run
from dln_jax.deploy.low_latency import enable_low_latency, low_latency
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.metrics.latency import one_step
from dln_jax.studies.arm.data import letters, published_split
from dln_jax.types import InputError
from dln_jax.zoo.run import load

NAME = "model"
NAMES = ("inverse", "forward")
STATES = 512


@dataclass(frozen=True)
class Arguments:
    """What to time."""

    runs: tuple[Path, ...]
    """Folders of trained runs of the two-link arm."""
    dispatch: Literal["default", "low-latency"] = "default"
    """default: jitted functions as they are; low-latency: without a change of threads, with NumPy in and out, and C."""
    calls: int = 20_000
    """Calls that are timed, of each."""


def main(given: Arguments) -> None:
    """Times, and prints JSON."""
    if given.dispatch == "low-latency":
        enable_low_latency()
    test = published_split(letters(None)).test
    states = {
        "inverse": tuple(array[:STATES] for array in (test.q, test.qd, test.qdd)),
        "forward": tuple(array[:STATES] for array in (test.q, test.qd, test.tau)),
    }
    print(json.dumps({folder.name: times_of(folder, states, given) for folder in given.runs}))


def times_of(folder: Path, states: dict[str, tuple[np.ndarray, ...]], given: Arguments) -> dict[str, Any]:
    """Of one run, by call path and function."""
    precision = json.loads((folder / "model.json").read_text())["model"]["precision"]
    dtype = {"f32": np.float32, "f64": np.float64}[precision]
    system = load(folder).dynamics
    host = {name: list(zip(*(array.astype(dtype) for array in states[name]), strict=True)) for name in NAMES}
    device = {name: [tuple(map(jnp.asarray, state)) for state in host[name]] for name in NAMES}
    if given.dispatch == "default":
        return {"default-jit": timed(jitted(system), device, given.calls)}
    packed = {name: low_latency(function, *host[name][0], numpy=True) for name, function in jitted(system).items()}
    found = {
        "low-latency-jit": timed(jitted(system), device, given.calls),
        "low-latency-numpy": timed(packed, host, given.calls),
    }
    with tempfile.TemporaryDirectory() as place:
        try:
            export_run(folder, Path(place), name=NAME)
        except InputError:
            return found  # a kind that is not exported
        exported = load_c(place, name=NAME)
        assert isinstance(exported, CDynamics)
        functions = {"inverse": exported.inverse_dynamics, "forward": exported.forward_dynamics}
        found["c-from-python"] = timed(functions, host, given.calls)
        found["c-loop"] = {"inverse": {"calls_per_second": calls_in_c(Path(place), 20 * given.calls)}}
    return found


def jitted(system: Dynamics | PlainDynamics) -> dict[str, Callable]:
    """The functions by name, closed over their parameters."""
    return {"inverse": jax.jit(system.inverse_dynamics), "forward": jax.jit(system.forward_dynamics)}


def calls_in_c(place: Path, calls: int) -> float:
    """Inverse-dynamics calls per second of the exported demo's own loop; the best of three runs."""
    demo = place / "demo"
    compile_c([*FLAGS, *WARNINGS, *map(str, place.glob("*.c")), "-lm", "-o", str(demo)])
    printed = [subprocess.run([demo, str(calls)], capture_output=True, text=True, check=True).stdout for _ in range(3)]
    return max(float(rate) for each in printed for rate in re.findall(r"(\d+) calls/s", each))


def timed(functions: dict[str, Callable], states: dict[str, list[tuple]], calls: int) -> dict[str, dict[str, float]]:
    """Latencies of each function."""
    return {name: one_step(function, states[name], calls=calls)._asdict() for name, function in functions.items()}


if __name__ == "__main__":
    run(main, Arguments, prog="python -m dln_jax.studies.speed.calls")
