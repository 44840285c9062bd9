"""Who takes part in a program of several processes: from a command's options, or from Slurm's environment."""

import os
import re
from collections.abc import Mapping
from typing import NamedTuple

from dln_jax.types import InputError

MOST_DIGITS = 18
"""Of a number of Slurm's."""
FIRST_PORT, PORTS = 61440, 4096
"""Above those that Linux gives to whoever asks for any."""
OF_STEP = ("SLURM_STEP_NUM_TASKS", "SLURM_JOB_ID", "SLURM_STEP_ID", "SLURM_STEP_NODELIST", "SLURM_PROCID")
"""What `srun` tells every task."""


class Place(NamedTuple):
    """One process among several."""

    processes: int
    coordinator: str
    """host:port of process 0."""
    process: int
    local_devices: tuple[int, ...] | None = None
    """Accelerators of the host that are this process's, by number; `None`: all that it sees."""
    found: str = "--processes"
    """What said so."""


def place_of(
    processes: int | None, coordinator: str | None, process: int | None, environ: Mapping[str, str] = os.environ
) -> Place | None:
    """This process's place, `None` if it is alone.

    Args:
        processes: how many; 1 is alone, also as one of Slurm's tasks.
        coordinator: host:port of process 0.
        process: which one this is, from 0.
        environ: where Slurm's variables are, which are read if nothing else is given.

    Raises:
        InputError: half of it is given, or what cannot be.
    """
    given = {"--processes": processes, "--coordinator": coordinator, "--process-id": process}
    absent = [option for option, value in given.items() if value is None]
    if processes is not None and processes < 1:
        raise InputError(f"--processes is {processes}; expected a positive whole number")
    if processes == 1:
        if len(absent) < 2:
            raise InputError("--processes is 1, which needs no --coordinator and no --process-id; leave them out")
        return None
    if len(absent) == len(given):
        return _of_slurm(environ)
    if processes is None or coordinator is None or process is None:
        there = " and ".join(option for option in given if option not in absent)
        raise InputError(f"{' and '.join(absent)} missing beside {there}; give all three, or none for one process")
    if not 0 <= process < processes:
        raise InputError(f"--process-id is {process}; of {processes} processes, expected 0 to {processes - 1}")
    address(coordinator)
    return Place(processes, coordinator, process)


def address(coordinator: str) -> tuple[str, int]:
    """Host and port; an IPv6 address stands in brackets.

    Raises:
        InputError: the text is no host:port.
    """
    found = re.fullmatch(r"(\[[0-9a-fA-F:.%\w]+\]|[^\s:\[\]/]+):(\d{1,5})", coordinator)
    if not found or not 0 < int(found[2]) < 2**16:
        raise InputError(f"--coordinator is {coordinator!r:.80}; expected host:port, such as node1:61440")
    return found[1].strip("[]"), int(found[2])


def _of_slurm(environ: Mapping[str, str]) -> Place | None:
    """The place of a task of a Slurm step."""
    tasks = _count(environ, "SLURM_STEP_NUM_TASKS", environ.get("SLURM_NTASKS", "1"))
    if tasks == 1:
        return None
    if absent := [name for name in OF_STEP if name not in environ]:
        raise InputError(
            f"Slurm has {tasks} tasks here, but does not set {', '.join(absent)}, as in a shell beside them; "
            "start with srun, or give --processes, --coordinator and --process-id (--processes 1: alone)"
        )
    job, step, process = (_count(environ, name) for name in ("SLURM_JOB_ID", "SLURM_STEP_ID", "SLURM_PROCID"))
    # A new attempt has another port: what is left of the last one does not meet it.
    attempt = _count(environ, "SLURM_RESTART_COUNT", "0")
    port = FIRST_PORT + (job + 509 * step + 1021 * attempt) % PORTS
    host = first_host(environ["SLURM_STEP_NODELIST"])
    return Place(tasks, f"{host}:{port}", process, local_devices(environ), "Slurm")


def first_host(nodes: str) -> str:
    """The first name in a list of Slurm's, such as node[007-009,12],gpu3.

    Raises:
        InputError: there is none.
    """
    found = re.match(r"([^,\[\s]+)(?:\[([^,\-\]]+)[^\]]*\]([^,\[]*))?", nodes)
    if not found:
        raise InputError(f"SLURM_STEP_NODELIST is {nodes!r:.80}, which names no host; give --coordinator host:port")
    return "".join(part or "" for part in found.groups())


def local_devices(environ: Mapping[str, str]) -> tuple[int, ...] | None:
    """A task's share of its host's accelerators, where Slurm shows every task all of them.

    With --gpus-per-task a task sees its own alone, numbered from 0.
    """
    visible = [name for name in environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    tasks = _tasks_here(environ)
    if "SLURM_GPUS_PER_TASK" in environ or tasks == 1 or len(visible) < tasks:
        return None
    share = len(visible) // tasks
    first = share * _count(environ, "SLURM_LOCALID", "0")
    return tuple(range(first, first + share))


def _tasks_here(environ: Mapping[str, str]) -> int:
    """Of this host, from a text such as 4(x2),3."""
    counts: list[int] = []
    for part in environ.get("SLURM_STEP_TASKS_PER_NODE", "1").split(","):
        if found := re.fullmatch(r"(\d{1,7})(?:\(x(\d{1,7})\))?", part):
            counts += [int(found[1])] * int(found[2] or 1)
    node = _count(environ, "SLURM_NODEID", "0")
    return counts[node] if node < len(counts) else 1


def _count(environ: Mapping[str, str], name: str, default: str | None = None) -> int:
    text = environ.get(name, default)
    if text is None or not text.isdecimal() or len(text) > MOST_DIGITS:
        raise InputError(f"{name} is {text!r:.40}, expected a whole number; give --processes (1: alone) and the rest")
    return int(text)
