"""One program on four devices, on one, and in two processes over loopback, each in an interpreter of its own."""

import os
import socket
import sys
from pathlib import Path

import jax
from interpreters import Program, interpreters

from dln_jax import precision


def run_on_all(path, folder):
    """Runs `PATH FOLDER NAME [PROCESS PORT]` for "four devices", then for "one device" and "first" and "second of two".

    What the first run leaves in the folder the others find there.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    flags = os.environ.get("XLA_FLAGS", "")

    def program(name, *process, devices=1):
        told = {**os.environ, "XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count={devices}"}
        return Program(path, folder, told, (str(folder), name, *process))

    with interpreters(dict(os.environ)) as run_programs:
        for beside in (
            [program("four devices", devices=4)],
            [program("one device"), program("first of two", "0", port), program("second of two", "1", port)],
        ):
            for result in run_programs(folder, *beside):
                assert result.returncode == 0, f"status {result.returncode}\n{result.stderr[-3000:]}"


def begun():
    """Within such a program: its folder and name, and whether it is one of two processes, which have met."""
    place, name, *process = sys.argv[1:]
    precision._OPTIONS.clear()  # the tests' own are quicker
    jax.config.update("jax_enable_x64", True)
    if process:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"127.0.0.1:{process[1]}", 2, int(process[0]))
    return Path(place), name, bool(process)
