"""One program in several processes: they meet, watch each other, and are joined by JAX's own runtime."""

import contextlib
import os
import socket
import sys
import time
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh

from dln_jax.scale.meeting import facts, meet
from dln_jax.scale.mesh import batch_mesh, gathered, shard
from dln_jax.scale.places import Place, address
from dln_jax.scale.signs import USUAL, Limits, Sign, has_left, own_sign, read, sign_folder, write
from dln_jax.scale.watchdog import watched
from dln_jax.scale.worker import say_joined
from dln_jax.types import InputError

FOR_EVER = 10**8
"""s; JAX's own limits would end a process by an abort."""


def host_devices(count: int | None) -> None:
    """Makes a processor so many devices, if a number is given and JAX has not yet been used.

    Raises:
        InputError: the number is not positive.
    """
    if count is None:
        return
    if count < 1:
        raise InputError(f"--devices is {count}; expected a positive whole number")
    with contextlib.suppress(RuntimeError):  # it has been used: `batch_mesh` says how many there are
        jax.config.update("jax_num_cpu_devices", count)


def process_key(key: Array) -> Array:
    """A random key of this process's own, from one that all have."""
    return jax.random.fold_in(key, jax.process_index())


def start(
    work: Callable[[], None],
    place: Place,
    folder: Path,
    arguments: Mapping[str, Any],
    *,
    devices: int | None = None,
    remedy: str = "start them again",
    limits: Limits = USUAL,
) -> int:
    """Does `work` in all processes, as one program of JAX, and gives the exit status.

    This process watches, and a child of it works, in which JAX has been joined; JAX must not have been used before.
    Where a process is lost, the others end with status 3.

    Args:
        work: what a process does, which ends with a `SystemExit` or normally.
        place: this process among them.
        folder: made for the time of the run, which all hosts see and none other uses.
        arguments: what the processes must agree in, JSON values by the names of options.
        devices: how many of each process share batches (default: all).
        remedy: what a user should do when a process was lost.
        limits: after which times what happens.

    Raises:
        InputError: a process does not come, they do not agree, the coordinator's port is taken, or JAX has been used.
    """
    require_unused()
    own = own_sign(facts(place, arguments))
    with sign_folder(folder, place.process, own.token):
        try:
            own = meet(folder, place, own, limits)
        except InputError as error:
            _refuse(folder, place, own, str(error), limits)
            raise
        return watched(lambda: _in_program(work, place, devices, limits), place, folder, own, limits, remedy)


def join(place: Place, devices: int | None, limits: Limits) -> None:
    """Makes this process part of the program, and says in process 0 what that is.

    Raises:
        InputError: the coordinator cannot be reached, JAX has been used already, or there are not so many devices.
    """
    host, port = address(place.coordinator)
    if place.process:
        _require_reachable(host, port, limits)
    host_devices(devices)
    # Its own way to be ended keeps a process alive that is told to go, and its requests take no detours.
    jax.config.update("jax_enable_preemption_service", False)
    jax.config.update("jax_check_proxy_envs", False)
    os.environ["no_grpc_proxy"] = host  # noqa: SIM112  gRPC's name
    try:
        jax.distributed.initialize(
            place.coordinator,
            place.processes,
            place.process,
            local_device_ids=place.local_devices,
            cluster_detection_method="deactivate",
            initialization_timeout=round(limits.joining),
            heartbeat_timeout_seconds=FOR_EVER,
            shutdown_timeout_seconds=FOR_EVER,
        )
        # Devices find each other when they first exchange numbers, and wait for 30 s: now all are at one place.
        hosts = _hosts(batch_mesh(devices))
    except InputError:
        raise
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0][:200]
        remedy = f"every host's name must lead the others to it ({socket.gethostname()} is this one's)"
        raise InputError(f"cannot join {place.coordinator}: {reason}; {remedy}") from None
    if place.process == 0:
        kind, local = jax.default_backend(), jax.local_device_count()
        many = f"{hosts} host{'s' * (hosts > 1)}"
        print(f"{place.processes} processes on {many} ({place.found}), {local} {kind} device{'s' * (local > 1)} each")


def require_unused() -> None:
    """Raises `InputError` if JAX has been used: it then refuses another number of devices."""
    devices = jax.config.values["jax_num_cpu_devices"]
    try:
        jax.config.update("jax_num_cpu_devices", devices + 1)
        jax.config.update("jax_num_cpu_devices", devices)
    except RuntimeError:
        raise InputError("JAX has been used in this process; several are started before it is") from None


def _in_program(work: Callable[[], None], place: Place, devices: int | None, limits: Limits) -> None:
    try:
        join(place, devices, limits)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error
    say_joined()
    if place.process:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115  to the process's end
    work()


def wait_for_all(mesh: Mesh | None) -> None:
    """Waits until all processes are here."""
    _hosts(mesh)


def _hosts(mesh: Mesh | None) -> int:
    """How many hosts there are; all devices take part in counting them."""
    name = zlib.crc32(socket.gethostname().encode()) % 2**31
    names = shard(np.full(1 if mesh is None else mesh.size, name), mesh)
    return len(np.unique(np.asarray(gathered(names))))


def _require_reachable(host: str, port: int, limits: Limits) -> None:
    """Waits for process 0's port to be open."""
    since = time.monotonic()
    while True:
        try:
            socket.create_connection((host, port), timeout=limits.joining).close()
            return
        except OSError as error:
            named = not isinstance(error, socket.gaierror)
            if not named or time.monotonic() - since > limits.joining:
                reason = error.strerror or error
                remedy = "give --coordinator an address of process 0's host and a port that are open to all"
                raise InputError(f"cannot reach {host}:{port} ({reason}); {remedy}") from None
        time.sleep(0.2)


def _refuse(folder: Path, place: Place, own: Sign, why: str, limits: Limits) -> None:
    """Says why, until the others have refused too, or must have read it."""
    others = [k for k in range(place.processes) if k != place.process and (k == 0 or place.process == 0)]
    until = time.monotonic() + 2 * (limits.beat + limits.grace)
    while time.monotonic() < until:
        last = read(folder, place.process)
        if last is not None and last.token != own.token:
            return
        own = own._replace(stage="ended", code=2, said=why, beat=own.beat + 1)
        write(folder, place.process, own)
        time.sleep(limits.beat / 2)
        signs = {k: read(folder, k) for k in others}
        if all(has_left(folder, k) or (sign and sign.stage in ("ended", "over")) for k, sign in signs.items()):
            return
