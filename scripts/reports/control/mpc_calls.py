"""Times calls of model predictive control along closed loops, in a separate process: one thread, low-latency mode.

JAX fixes the low-latency mode when it starts, hence the process. Prints one line of JSON.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.cli.running import run
from dln_jax.control import first_plan, mpc
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.export.low_latency import enable_low_latency
from dln_jax.mechanics.integrators import CLASSICAL, advance, runge_kutta
from dln_jax.types import InputError
from scripts.reports.control.mpc import HANGING, RATE, cart_pole_problem, field, starts

ROOT = Path(__file__).parents[3]
"""Folder of the package that the process imports."""
LIMIT = 170.0
"""Time limit of the process, s."""
ONE_THREAD = "--xla_cpu_multi_thread_eigen=false"
STACK = 2**20
"""Stack limit of a call in C, bytes."""
SECONDS = 3.0
"""Length of a closed loop, which covers the swing-up and balancing."""


@dataclass(frozen=True)
class Arguments:
    """What to time."""

    steps: int = 80
    """Of the horizon."""
    loops: int = 20
    """Closed loops of three seconds, each from another start."""


class Calls(NamedTuple):
    """Times of successive calls, and of the compilation."""

    compile_seconds: float
    p50_ms: float
    p99_ms: float
    worst_ms: float
    calls: int


def main(given: Arguments) -> None:
    """Times JAX, and C if there is a compiler, and prints JSON."""
    enable_low_latency()
    jax.config.update("jax_enable_x64", True)
    act = one_call(given.steps)
    first = jax.tree.map(np.asarray, first_state(given.steps))
    began = time.perf_counter()
    compiled = jax.jit(act)
    jax.block_until_ready(compiled(*first))
    compile_seconds = time.perf_counter() - began
    found = {"jax": timed(compiled, first, given.loops, compile_seconds)._asdict()}
    with tempfile.TemporaryDirectory() as place:
        began = time.perf_counter()
        try:
            export_c({"act": (act, first)}, Path(place) / "plan", stack=STACK)
            in_c = load_c(Path(place) / "plan").act
            found["c"] = timed(in_c, first, given.loops, time.perf_counter() - began)._asdict()
        except InputError as error:
            print(f"no C: {error}", file=sys.stderr)
    print(json.dumps(found))


def one_call(steps: int) -> Callable[..., Any]:
    """(x, u, states, K, damping) -> the control, and the next u, states, K and damping."""
    act = mpc(cart_pole_problem())
    plan = first_plan(cart_pole_problem(), HANGING, np.zeros((steps, 1)))

    def call(x: Any, u: Any, about: Any, K: Any, damping: Any) -> Any:
        control, found = act(x, plan._replace(u=u, x=about, K=K, damping=damping))
        return {"control": control, "planned": found.u, "states": found.x, "gains": found.K, "size": found.damping}

    return call


def first_state(steps: int) -> tuple[Any, ...]:
    """Arguments of the first call: hanging, with a plan without force."""
    plan = first_plan(cart_pole_problem(), HANGING, np.zeros((steps, 1)))
    return HANGING, plan.u, plan.x, plan.K, plan.damping


def timed(act: Callable[..., Any], first: tuple[Any, ...], loops: int, compile_seconds: float) -> Calls:
    """Times all calls along some closed loops."""
    plant = field()
    after = jax.jit(
        lambda x, u: advance(runge_kutta(CLASSICAL, lambda t, state: plant(state, u)), 0.0, x, 1 / RATE, substeps=4)
    )
    nanoseconds = []
    for x in starts(loops, seed=1):
        plan = first[1:]
        for _ in range(round(SECONDS * RATE)):
            start = time.perf_counter_ns()
            answer = jax.block_until_ready(act(x, *plan))
            nanoseconds.append(time.perf_counter_ns() - start)
            named = answer if isinstance(answer, dict) else answer._asdict()
            # The C binding returns the names of the dictionary, possibly with a suffix.
            named = {key.removesuffix("_result"): value for key, value in named.items()}
            control, *plan = (np.asarray(named[key]) for key in ("control", "planned", "states", "gains", "size"))
            x = np.asarray(after(x, control))
    p50, p99, worst = (float(each) for each in np.percentile(np.array(nanoseconds) / 1e6, [50, 99, 100]))
    return Calls(compile_seconds, p50, p99, worst, len(nanoseconds))


def calls_in_a_process(steps: int, loops: int) -> dict[str, Calls]:
    """Runs this module in a process; returns the calls of "jax" and "c". `InputError` if the process fails."""
    command = [sys.executable, "-m", "scripts.reports.control.mpc_calls"]
    flags = f"{os.environ.get('XLA_FLAGS', '')} {ONE_THREAD}"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags.strip(), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, "--steps", str(steps), "--loops", str(loops)],
        capture_output=True, cwd=ROOT, env=environment, timeout=LIMIT, text=True,
    )  # fmt: skip
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["it printed nothing"]
        raise InputError(f"calls were not timed ({lines[-1]})")
    return {name: Calls(**found) for name, found in json.loads(done.stdout.strip().splitlines()[-1]).items()}


if __name__ == "__main__":
    run(main, Arguments, prog="python -m scripts.reports.control.mpc_calls")
