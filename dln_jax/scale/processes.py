"""One program in several processes: `jax.distributed` connects them, and ends them when one is lost."""

import contextlib
import importlib.metadata
import json
import os
import platform
import re
import socket
import threading
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils

from dln_jax.errors import InputError, ProcessLost

HEARTBEAT = 10
"""After this many seconds without a heartbeat JAX treats a process as lost and ends the others."""
SHUTDOWN = 300
"""Seconds that the processes may take to shut down; process 0 may still write its figures."""
JOINING = 120
"""Time limit for the start of all processes, s."""
MOST_OPTIONS = 256
"""Largest number of options and versions that the processes compare."""
_TASKS = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")
"""Environment variables of `srun` and `mpirun` that state the number of their processes."""
_ADDRESS = re.compile(r"(\[[0-9a-fA-F:.%\w]+\]|[^\s:\[\]/]+):(\d{1,5})", re.ASCII)
_OF_PEERS = re.compile(r"gloo|nccl|coordination|unavailable|deadline_exceeded", re.IGNORECASE)


class Membership(NamedTuple):
    """How a process joins others; if all fields are `None`, JAX reads them from the cluster's variables."""

    coordinator: str | None = None
    """host:port of process 0."""
    processes: int | None = None
    process: int | None = None


def host_devices(count: int | None) -> None:
    """Splits the CPU into `count` JAX devices, unless it is None or JAX runs already; `InputError` below 1."""
    if count is None:
        return
    if count < 1:
        raise InputError(f"--devices is {count}; expected a positive whole number")
    with contextlib.suppress(RuntimeError):  # already used; `batch_mesh` reports the number of devices
        jax.config.update("jax_num_cpu_devices", count)


def membership(
    processes: int | None, coordinator: str | None, process: int | None, environ: Mapping[str, str] = os.environ
) -> Membership | None:
    """Returns how this process joins others, or `None` for a single process.

    Args:
        processes: number of processes; 1 means a single process, also within a cluster's step.
        coordinator: host:port of process 0; an IPv6 address stands in brackets.
        process: index of this process, from 0.
        environ: environment with the variables of `srun` or `mpirun`, read if all other arguments are None.

    Raises:
        InputError: an argument is missing or out of range.
    """
    options = {"--processes": processes, "--coordinator": coordinator, "--process-id": process}
    absent = [option for option, value in options.items() if value is None]
    if processes is not None and processes < 1:
        raise InputError(f"--processes is {processes}; expected a positive whole number")
    if processes == 1:
        if len(absent) < 2:
            raise InputError("--processes is 1, which needs no --coordinator and no --process-id; leave them out")
        return None
    if len(absent) == len(options):
        return Membership() if any(environ.get(name, "1") != "1" for name in _TASKS) else None
    if processes is None or coordinator is None or process is None:
        present = " and ".join(option for option in options if option not in absent)
        raise InputError(f"{' and '.join(absent)} missing beside {present}; give all three, or none for one process")
    if not 0 <= process < processes:
        raise InputError(f"--process-id is {process}; of {processes} processes, expected 0 to {processes - 1}")
    parts = _ADDRESS.fullmatch(coordinator)
    if not parts or not coordinator.isascii() or not 0 < int(parts[2]) < 2**16:
        raise InputError(f"--coordinator is {coordinator!r:.80}; expected host:port, such as node1:61440")
    return Membership(coordinator, processes, process)


def join(member: Membership, options: Mapping[str, Any], *, seconds: int = JOINING) -> None:
    """Connects this process to the others; JAX must not have been used before.

    Args:
        member: how this process joins.
        options: JSON values by name that decide the result; they must be equal in all processes.
        seconds: time limit for the start of all processes.

    Raises:
        InputError: the address cannot be used, a process is missing, or two differ. JAX may go on connecting in a
            thread, so that the caller should end the process at once.
    """
    where = member.coordinator or "the cluster"
    claim = _claimed_address(member)
    # JAX's handler of SIGTERM would keep a process alive that is asked to end.
    jax.config.update("jax_enable_preemption_service", False)
    errors = []

    def connect() -> None:
        try:
            jax.distributed.initialize(
                *member,
                initialization_timeout=10 * seconds,
                heartbeat_timeout_seconds=HEARTBEAT,
                shutdown_timeout_seconds=SHUTDOWN,
            )
        except (RuntimeError, ValueError) as error:
            errors.append(error)

    # When JAX's own time for this is up, it aborts the process with a C++ trace. Ctrl-C would have to wait for it, too.
    thread = threading.Thread(target=connect, daemon=True)
    thread.start()
    thread.join(seconds)
    claim.close()
    if thread.is_alive():
        count = "the processes" if member.processes is None else f"the {member.processes} processes"
        raise InputError(
            f"{count} did not meet at {where} within {seconds} s; start the same command once for each --process-id, "
            "with an address of process 0's host that all can reach"
        )
    if errors:
        raise InputError(f"cannot join {where}: {_first_line(errors[0])}")
    if reason := _difference(options):
        jax.distributed.shutdown()
        raise InputError(f"{reason}; all processes need the same command and versions")
    if jax.process_index() == 0:
        local, kind = jax.local_device_count(), jax.default_backend()
        print(f"{jax.process_count()} processes, {local} {kind} device{'s' * (local > 1)} each")


def _claimed_address(member: Membership) -> contextlib.ExitStack:
    """Returns what keeps other processes 0 away until it is closed.

    Raises:
        InputError: the host has no address, or the port is not free; JAX would wait in both cases.
    """
    if member.coordinator is None:
        return contextlib.ExitStack()
    host, _, port = member.coordinator.rpartition(":")
    try:
        with contextlib.ExitStack() as claim:
            if member.process:
                socket.getaddrinfo(host.strip("[]"), int(port))
            else:
                # JAX's servers share a port, and a process that finds another of its index aborts. The UDP port has one
                # owner until JAX listens.
                claim.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)).bind(("", int(port)))
                socket.create_server(("", int(port))).close()
            return claim.pop_all()
    except socket.gaierror as error:
        raise InputError(f"cannot reach {member.coordinator} ({error.strerror}); check --coordinator") from None
    except OSError as error:
        raise InputError(f"port {port} of --coordinator is not free ({error.strerror}); choose another") from None


def _difference(options: Mapping[str, Any]) -> str:
    """Returns the first difference between the processes, the same in all of them; empty if there is none."""
    counts = Counter(device.process_index for device in jax.devices())
    for process, count in sorted(counts.items()):
        if count != counts[0]:
            return f"--devices: process 0 has {counts[0]}, process {process} has {count}"
    packages = {name: importlib.metadata.version(name) for name in ("dln-jax", "jax", "jaxlib")}
    record = {"Python": platform.python_version(), **packages, **options}
    digests = np.zeros(MOST_OPTIONS, np.uint32)
    digests[: len(record)] = [zlib.crc32(json.dumps(value).encode()) for value in record.values()]
    gathered = multihost_utils.process_allgather(digests)
    if not len(places := np.argwhere(gathered != gathered[0])):
        return ""
    process, place = places[0]
    name, value = list(record.items())[place]
    return f"{name} differs between process 0 and process {process}; it is {value!r:.60} in this one"


@contextlib.contextmanager
def losses_named(remedy: str) -> Iterator[None]:
    """Turns the error of a collective whose peer is lost into a `ProcessLost` that ends with a remedy."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        if jax.process_count() == 1 or not _OF_PEERS.search(str(error)):
            raise
        raise ProcessLost(f"another process is lost ({_first_line(error)}); {remedy}") from error


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
