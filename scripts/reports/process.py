"""Calls of functions in processes of their own: JAX fixes its mode of dispatch and its threads when it starts."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dln_jax.training.low_latency_calls import last_line
from dln_jax.types import InputError

ROOT = Path(__file__).parents[2]
"""Folder of the packages that a process imports."""
PROGRAM = """
import importlib, json, sys
from pathlib import Path
import jax
jax.config.update("jax_enable_x64", True)
module, name, arguments = json.loads(sys.argv[1])
answer = getattr(importlib.import_module(module), name)(*arguments)
Path("answer.json").write_text(json.dumps(answer, default=float))
"""


def called(function: Callable[..., Any], *arguments: Any, limit: float | None = None, **environment: str) -> Any:
    """The answer of a function of a module, in float64, computed by a new process on the CPU.

    Args:
        function: function at the top level of a module; JSON holds its answer, so that tuples come back as lists.
        arguments: its arguments: numbers, strings, lists of these, and paths, which arrive as strings.
        limit: time limit, s.
        environment: more environment variables of the process.

    Raises:
        InputError: the process failed; the message has the last line that it printed.
    """
    with tempfile.TemporaryDirectory() as place:
        call = json.dumps((function.__module__, function.__qualname__, arguments), default=str)
        command = [sys.executable, "-c", PROGRAM, call]
        settings = {"JAX_PLATFORMS": "cpu", "PYTHONPATH": search_path(), **environment}
        try:
            done = subprocess.run(
                command, capture_output=True, cwd=place, env={**os.environ, **settings}, timeout=limit
            )
        except subprocess.TimeoutExpired:
            raise InputError(f"a measurement in a process of its own did not end in {limit:g} s") from None
        if done.returncode:
            raise InputError(f"a measurement in a process of its own failed: {last_line(done.stderr)}")
        return json.loads((Path(place) / "answer.json").read_text())


def search_path() -> str:
    """PYTHONPATH with which a process finds the repository."""
    return os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
