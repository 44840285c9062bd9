"""Programs in fresh interpreters, each forked from one that has imported JAX and the library, and done nothing else."""

import json
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
SECONDS = 300
"""After which a program is ended."""
SERVER = """
import gc
import json
import os
import runpy
import signal
import sys

import diffrax
import matplotlib.pyplot
import scipy.optimize
import scipy.signal

import dln_jax

gc.set_threshold(200_000, 20, 100)  # as in the tests: collecting among what was traced is in vain
for line in sys.stdin:
    children = []
    for program in json.loads(line):
        if not (child := os.fork()):
            break
        children.append(child)
    else:
        print(json.dumps([os.waitstatus_to_exitcode(os.waitpid(each, 0)[1]) for each in children]), flush=True)
        continue
    break  # is a child
else:
    sys.exit()
signal.alarm(program["seconds"])
os.chdir(program["folder"])
os.environ.clear()
os.environ.update(program["environment"])
for descriptor, (name, flags) in enumerate(
    [(os.devnull, os.O_RDONLY), *((program[key], os.O_WRONLY | os.O_CREAT | os.O_TRUNC) for key in ("out", "err"))]
):
    os.dup2(os.open(name, flags), descriptor)
sys.argv = [program["path"], *program["arguments"]]
runpy.run_path(program["path"], run_name="__main__")
"""


class Program(NamedTuple):
    """A program for `python PATH ARGUMENTS`."""

    path: Path
    folder: Path
    """Working folder."""
    environment: dict[str, str]
    """The whole environment; variables that JAX reads on import are those of the first interpreter."""
    arguments: tuple[str, ...] = ()


class Result(NamedTuple):
    """Outcome of a program."""

    returncode: int
    stdout: str
    stderr: str


@contextmanager
def interpreters(environment):
    """A function that runs programs beside each other, and gives the result of each."""
    command = [sys.executable, "-c", SERVER]
    environment = {**environment, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        count = 0

        def run(folder, *programs):
            """Programs, whose output is put into files of the folder."""
            nonlocal count
            tasks = []
            for program in programs:
                said = {key: str(folder / f"{key}-{count}.txt") for key in ("out", "err")}
                count += 1
                given = {"path": str(program.path), "folder": str(program.folder), "arguments": program.arguments}
                tasks.append({**given, **said, "environment": program.environment, "seconds": SECONDS})
            print(json.dumps(tasks), file=server.stdin, flush=True)
            codes = json.loads(server.stdout.readline())
            texts = [[Path(task[key]).read_text() for key in ("out", "err")] for task in tasks]
            return [Result(code, *text) for code, text in zip(codes, texts, strict=True)]

        yield run
        server.stdin.close()
