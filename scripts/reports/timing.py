"""Tools that measurements share: programs timed in turns, functions called in processes of their own, and CasADi."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dln_jax.types import InputError

ROOT = Path(__file__).parents[2]
"""Folder of the packages that a process imports."""
PROGRAM = """
import importlib, json, sys
import jax
jax.config.update("jax_enable_x64", True)
module, name, arguments = json.loads(sys.argv[1])
print(json.dumps(getattr(importlib.import_module(module), name)(*arguments), default=float))
"""


def medians_in_turns(
    programs: Mapping[str, Callable[..., Any]],
    arguments: Mapping[str, Callable[[], tuple]] | tuple,
    *,
    repetitions: int,
    warm_up: int = 2,
) -> dict[str, float]:
    """Median wall-clock seconds of compiled programs until their results are ready.

    The programs take turns, so that a slow period of the machine affects all of them.

    Args:
        arguments: those of all programs, or functions that make those of each, which are not timed.
    """
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    for repetition in range(-warm_up, repetitions):
        for name, program in programs.items():
            values = arguments if isinstance(arguments, tuple) else jax.block_until_ready(arguments[name]())
            start = time.perf_counter()
            jax.block_until_ready(program(*values))
            if repetition >= 0:
                seconds[name].append(time.perf_counter() - start)
    return {name: float(np.median(values)) for name, values in seconds.items()}


def called(function: Callable[..., Any], *arguments, **environment: str):
    """The answer of a function of a module, in float64, computed by a new process on the CPU.

    JAX fixes its mode of dispatch and its threads when it starts.

    Args:
        function: function at the top level of a module, which prints nothing after it has returned; JSON holds its
            answer, so that tuples come back as lists.
        arguments: numbers, strings, lists of these, and paths, which arrive as strings.
        environment: more environment variables of the process.

    Raises:
        InputError: the process failed; the message has the last line that it printed.
    """
    call = json.dumps((function.__module__, function.__qualname__, arguments), default=str)
    settings = {**os.environ, "JAX_PLATFORMS": "cpu", **environment}
    done = subprocess.run([sys.executable, "-c", PROGRAM, call], capture_output=True, cwd=ROOT, env=settings)
    if done.returncode:
        raise InputError(f"a measurement in a process of its own failed: {last_line(done.stderr)}")
    return json.loads(last_line(done.stdout))


def casadi():
    """The module of CasADi; `InputError` if it is not installed."""
    try:
        import casadi as ca
    except ImportError as error:
        raise InputError("this measurement needs CasADi: pip install casadi") from error
    return ca


def last_line(output: bytes) -> str:
    """The last line of a process's output."""
    return (output.decode(errors="replace").strip().splitlines() or ["it printed nothing"])[-1]
