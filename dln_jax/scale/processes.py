"""One program in several processes: `jax.distributed` connects them, and ends them when one is lost."""

import contextlib
import os
import re
from collections.abc import Iterator, Mapping
from typing import Any

import jax
from jax import Array

from dln_jax.errors import InputError, ProcessLost
from dln_jax.scale.meeting import Membership, address, meet

HEARTBEAT = 10
"""Seconds without a heartbeat after which JAX treats a process as lost and ends the others."""
SHUTDOWN = 300
"""Seconds that the processes may take to shut down; process 0 may still write its figures."""
JOINING = 120
"""Seconds within which all processes must have started."""
_TASKS = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")
"""Environment variables in which `srun` and `mpirun` state the number of their processes."""
_OF_PEERS = re.compile(r"gloo|nccl|coordination|unavailable|deadline_exceeded", re.IGNORECASE)


def host_devices(count: int | None) -> None:
    """Splits the CPU into `count` JAX devices, unless it is None or JAX has already been used.

    Raises:
        InputError: the number is not positive.
    """
    if count is None:
        return
    if count < 1:
        raise InputError(f"--devices is {count}; expected a positive whole number")
    with contextlib.suppress(RuntimeError):  # already used; `batch_mesh` reports the number of devices
        jax.config.update("jax_num_cpu_devices", count)


def process_key(key: Array) -> Array:
    """Returns a random key for this process, from one that all processes share."""
    return jax.random.fold_in(key, jax.process_index())


def membership(
    processes: int | None, coordinator: str | None, process: int | None, environ: Mapping[str, str] = os.environ
) -> Membership | None:
    """Returns how this process joins others, or `None` for a single process.

    Args:
        processes: number of processes; 1 means a single process, also within a cluster's step.
        coordinator: host:port of process 0.
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
    address(coordinator)
    return Membership(processes, coordinator, process)


def join(member: Membership, options: Mapping[str, Any], *, seconds: int = JOINING) -> None:
    """Connects this process to the others; JAX must not have been used before.

    Args:
        member: how this process joins.
        options: JSON values by name that decide the result; they must be equal in all processes.
        seconds: time within which all processes must have started.

    Raises:
        InputError: JAX has been used, the coordinator is unreachable, a process is missing, or two differ.
    """
    require_unused()
    if member.coordinator is not None:
        # Without this, JAX aborts with a C++ trace if a process is missing or the port is taken.
        meet(member, options, seconds)
    # JAX's handler of SIGTERM would keep a process alive that is asked to end.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            member.coordinator,
            member.processes,
            member.process,
            initialization_timeout=seconds,
            heartbeat_timeout_seconds=HEARTBEAT,
            shutdown_timeout_seconds=SHUTDOWN,
        )
    except (RuntimeError, ValueError) as error:
        raise InputError(f"cannot join {member.coordinator or 'the cluster'}: {_first_line(error)}") from None
    if jax.process_index() == 0:
        local, kind = jax.local_device_count(), jax.default_backend()
        print(f"{jax.process_count()} processes, {local} {kind} device{'s' * (local > 1)} each")


def require_unused() -> None:
    """Raises `InputError` if JAX has been used, which shows in its refusal of another number of devices."""
    devices = jax.config.values["jax_num_cpu_devices"]
    try:
        jax.config.update("jax_num_cpu_devices", devices + 1)
        jax.config.update("jax_num_cpu_devices", devices)
    except RuntimeError:
        raise InputError("JAX has been used in this process; several are started before it is") from None


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
