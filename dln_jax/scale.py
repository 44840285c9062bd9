"""Runs one program on several devices and in several processes.

A mesh with a single axis splits every batch along axis 0 and replicates shared arrays, such as parameters, on every
device. `spread` gathers the results in batch order, so the rest of a program does not depend on the number of devices.
Functions run by `on_devices` call the collectives `total`, `mean` and `first` themselves. The order of their sums, and
therefore the rounding, depends on the number of devices. With no mesh (`None`) all of these return their argument.

`membership` and `join` connect processes through `jax.distributed`, which ends all of them when one is lost.
"""

import contextlib
import importlib.metadata
import json
import os
import platform
import re
import socket
import statistics
import threading
import timeit
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import multihost_utils
from jax.extend import core
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from dln_jax.errors import InputError, ProcessLost

REPETITIONS = 5
EXPENSIVE = 4.0
"""Time of float64 relative to float32 above which a training recommends float32."""
AXIS = "batch"
"""Name of the mesh axis."""
SPLIT, WHOLE = PartitionSpec(AXIS), PartitionSpec()

OfBatch = Callable[[Any, Any], Any]
"""(shared arrays, batch on axis 0 of every leaf) -> results."""
HEARTBEAT = 10
"""Seconds without a heartbeat after which JAX treats a process as lost and ends the others."""
SHUTDOWN = 300
"""Time limit for the shutdown of all processes, s; process 0 may still be writing figures."""
JOINING = 120
"""Time limit for the start of all processes, s."""
MOST_OPTIONS = 256
"""Largest number of options and versions compared between processes."""
_TASKS = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")
"""Environment variables in which `srun` and `mpirun` state their number of processes."""
_ADDRESS = re.compile(r"(\[[0-9a-fA-F:.%\w]+\]|[^\s:\[\]/]+):(\d{1,5})", re.ASCII)
_OF_PEERS = re.compile(r"gloo|nccl|coordination|unavailable|deadline_exceeded", re.IGNORECASE)


def batch_mesh(devices: int | None = None) -> Mesh | None:
    """Returns a mesh that splits batches over devices, or `None` for a single device.

    Args:
        devices: number of devices per process (default: every device that JAX sees).

    Raises:
        InputError: a process has fewer devices.
    """
    local = jax.local_device_count()
    count = local if devices is None else devices
    if not 1 <= count <= local:
        raise InputError(f"--devices is {count}; JAX sees {local} here ({jax.default_backend()}), give 1 to {local}")
    by_process = [jax.local_devices(process_index=process)[:count] for process in range(jax.process_count())]
    chosen = np.array([device for of_one in by_process for device in of_one])
    return Mesh(chosen, (AXIS,)) if len(chosen) > 1 else None


def shares(mesh: Mesh | None, count: int, what: str) -> int:
    """Returns the number of items (`what`, plural) per device; `InputError` unless it is a whole number."""
    devices = 1 if mesh is None else mesh.size
    if count % devices:
        remedy = f"give a multiple of {devices}, or fewer devices"
        raise InputError(f"{count} {what} cannot be split over {devices} devices; {remedy}")
    return count // devices


def shard(tree: Any, mesh: Mesh | None) -> Any:
    """Splits arrays along axis 0 over the devices; every process passes the whole arrays and keeps its own part.

    Raises:
        InputError: the number of devices does not divide the length of an array.
    """
    if mesh is None:
        return tree
    for leaf in jax.tree.leaves(tree):
        shares(mesh, np.shape(leaf)[0], "rows of an array")
    return _placed(tree, NamedSharding(mesh, SPLIT))


def replicate(tree: Any, mesh: Mesh | None) -> Any:
    """Replicates arrays on every device; all processes pass the same arrays."""
    return tree if mesh is None else _placed(tree, NamedSharding(mesh, WHOLE))


def program(function: Callable[..., Any], mesh: Mesh | None, **options: Any) -> Any:
    """Applies `jax.jit` to a function whose arguments and results are replicated on every device of the mesh.

    Arguments may be local arrays if all processes pass the same. `options` are passed to `jax.jit`.
    """
    whole = {} if mesh is None else dict.fromkeys(("in_shardings", "out_shardings"), NamedSharding(mesh, WHOLE))
    return jax.jit(function, **whole, **options)


def local(tree: Any, mesh: Mesh | None) -> Any:
    """Copies replicated arrays to the first device of this process."""
    return tree if mesh is None else jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), tree)


def of_first_process(value: bool | float, mesh: Mesh | None) -> bool | float:
    """Returns the value of process 0 in every process, for numbers that may differ, such as times."""
    if mesh is None or jax.process_count() == 1:
        return value
    # A gather over all devices reuses their connections; a broadcast would open new ones.
    return type(value)(multihost_utils.process_allgather(shard(np.full(mesh.size, value), mesh), tiled=True)[0])


def spread(function: OfBatch, mesh: Mesh | None) -> OfBatch:
    """Splits the batch of a function over the devices; every device gets all results.

    The function must treat samples independently, as `vmap` does. If the number of devices does not divide the batch,
    copies of its first sample pad it and their results are dropped. The result is differentiable in forward mode; take
    reverse-mode derivatives inside the function.
    """
    if mesh is None:
        return function

    def on_one(shared: Any, batch: Any) -> Any:
        return jax.tree.map(lambda leaf: lax.all_gather(leaf, AXIS, tiled=True), function(shared, batch))

    on_all = on_devices(on_one, mesh)

    def on_batch(shared: Any, batch: Any) -> Any:
        count = jax.tree.leaves(batch)[0].shape[0]
        fillers = -count % mesh.size
        rows = np.append(np.arange(count), np.zeros(fillers, int))
        results = on_all(shared, jax.tree.map(lambda leaf: leaf[rows], batch) if fillers else batch)
        return jax.tree.map(lambda leaf: leaf[:count], results) if fillers else results

    return on_batch


def on_devices(function: OfBatch, mesh: Mesh | None) -> OfBatch:
    """Runs a function on the part of the batch that each device holds.

    The function must return the same values on all devices, which `total`, `mean` and `first` ensure. The number of
    devices must divide the batch. Loops and branches that contain collectives must take the same course on all devices.
    """
    if mesh is None:
        return function
    # check_vma would reject loops whose length differs between devices.
    return jax.shard_map(
        _with_empty_arrays_made_inside(function), mesh=mesh, in_specs=(WHOLE, SPLIT), out_specs=WHOLE, check_vma=False
    )


def total(tree: Any, mesh: Mesh | None) -> Any:
    """Returns the sum over devices; call it within `on_devices`."""
    return tree if mesh is None else lax.psum(tree, AXIS)


def mean(tree: Any, mesh: Mesh | None) -> Any:
    """Returns the mean over devices; call it within `on_devices`."""
    return tree if mesh is None else lax.pmean(tree, AXIS)


def first(tree: Any, mesh: Mesh | None) -> Any:
    """Returns the first device's values, since other devices may round differently; call it within `on_devices`."""
    return tree if mesh is None else jax.tree.map(lambda leaf: lax.all_gather(leaf, AXIS)[0], tree)


def share(array: jax.Array, mesh: Mesh | None, *, axis: int) -> jax.Array:
    """Returns this device's part of a replicated array along an axis; call it within `on_devices`."""
    if mesh is None:
        return array
    size = array.shape[axis] // mesh.size
    return lax.dynamic_slice_in_dim(array, lax.axis_index(AXIS) * size, size, axis)


def _with_empty_arrays_made_inside(function: OfBatch) -> OfBatch:
    """Creates empty arguments and constants inside the function instead of passing them.

    In jaxlib 0.11.2, XLA removes the empty inputs of a `shard_map` and then crashes on the others (docs/scale.md).
    """

    def on_one(shared: Any, batch: Any) -> Any:
        arguments = _made_if_empty((shared, batch))
        # Tracing finds the constants that the function closes over, also in its loops.
        traced, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
        closed = core.ClosedJaxpr(traced.jaxpr, _made_if_empty(traced.consts))
        return jax.tree.unflatten(jax.tree.structure(shapes), core.jaxpr_as_fun(closed)(*jax.tree.leaves(arguments)))

    return on_one


def _made_if_empty(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype) if np.size(leaf) == 0 else leaf, tree)


def _placed(tree: Any, sharding: NamedSharding) -> Any:
    def place(leaf: Any) -> jax.Array:
        # Built from this process's copy, because `device_put` would first compare the copies of all processes.
        array = np.asarray(leaf)
        return jax.make_array_from_callback(array.shape, sharding, lambda index: jnp.asarray(array[index]))

    return jax.tree.map(place, tree)


Membership = tuple[str | None, int | None, int | None]
"""host:port of process 0, number of processes, index of this process; all `None` if JAX asks the cluster for them."""


def host_devices(count: int | None) -> None:
    """Splits the CPU into `count` JAX devices if JAX has not started yet; `InputError` below 1."""
    if count is None:
        return
    if count < 1:
        raise InputError(f"--devices is {count}; expected a positive whole number")
    with contextlib.suppress(RuntimeError):  # already used; `batch_mesh` reports the number of devices
        jax.config.update("jax_num_cpu_devices", count)


def membership(
    processes: int | None, coordinator: str | None, process: int | None, environ: Mapping[str, str] = os.environ
) -> Membership | None:
    """Returns the arguments with which this process joins the others, or `None` for a single process.

    Args:
        processes: number of processes; 1 means a single process, also under `srun` and `mpirun`.
        coordinator: host:port of process 0, with an IPv6 address in brackets.
        process: index of this process, from 0.
        environ: environment variables; those of `srun` and `mpirun` count if all other arguments are `None`.

    Raises:
        InputError: an argument is missing or out of range.
    """
    options = {"--processes": processes, "--coordinator": coordinator, "--process-id": process}
    absent = [option for option, value in options.items() if value is None]
    if processes is not None and processes < 1:
        raise InputError(f"--processes is {processes}; expected a positive whole number")
    if processes == 1:
        if len(absent) < 2:
            raise InputError("--processes is 1; leave out --coordinator and --process-id")
        return None
    if len(absent) == len(options):
        return (None, None, None) if any(environ.get(name, "1") != "1" for name in _TASKS) else None
    if processes is None or coordinator is None or process is None:
        present = " and ".join(option for option in options if option not in absent)
        raise InputError(f"{' and '.join(absent)} missing beside {present}; give all three, or none for one process")
    if not 0 <= process < processes:
        raise InputError(f"--process-id is {process}; of {processes} processes, expected 0 to {processes - 1}")
    parts = _ADDRESS.fullmatch(coordinator)
    if not parts or not coordinator.isascii() or not 0 < int(parts[2]) < 2**16:
        raise InputError(f"--coordinator is {coordinator!r:.80}; expected host:port, such as node1:61440")
    return coordinator, processes, process


def join(member: Membership, options: Mapping[str, Any], *, seconds: int = JOINING) -> None:
    """Connects this process to the others; call it before any other use of JAX.

    Args:
        member: from `membership`.
        options: JSON values by name that affect the result; they must be equal in all processes.
        seconds: time limit for the start of all processes.

    Raises:
        InputError: the address cannot be used, a process is missing, or two processes differ. End the process at once,
            because a thread of JAX may still be trying to connect.
    """
    coordinator, processes, process = member
    where = coordinator or "the cluster"
    claim = _claimed_address(coordinator, process)
    # JAX's SIGTERM handler would keep the process alive.
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

    # At its own time limit JAX aborts the process with a C++ trace. In the main thread it would also delay Ctrl-C.
    thread = threading.Thread(target=connect, daemon=True)
    thread.start()
    thread.join(seconds)
    claim.close()
    if thread.is_alive():
        count = "the processes" if processes is None else f"the {processes} processes"
        raise InputError(
            f"{count} did not meet at {where} within {seconds} s; start the same command once for each --process-id, "
            "with an address of process 0 that every host can reach"
        )
    if errors:
        raise InputError(f"cannot join {where}: {_first_line(errors[0])}")
    if reason := _difference(options):
        jax.distributed.shutdown()
        raise InputError(f"{reason}; all processes need the same command and versions")
    if jax.process_index() == 0:
        local, kind = jax.local_device_count(), jax.default_backend()
        print(f"{jax.process_count()} processes, {local} {kind} device{'s' * (local > 1)} each")


def _claimed_address(coordinator: str | None, process: int | None) -> contextlib.ExitStack:
    """Reserves the address of process 0 until the returned stack is closed.

    Raises:
        InputError: the host name does not resolve, or the port is in use; JAX would wait in both cases.
    """
    if coordinator is None:
        return contextlib.ExitStack()
    host, _, port = coordinator.rpartition(":")
    try:
        with contextlib.ExitStack() as claim:
            if process:
                socket.getaddrinfo(host.strip("[]"), int(port))
            else:
                # Two servers of JAX can share a TCP port, and JAX then aborts the second process 0. A UDP port has a
                # single owner, so it guards the address until JAX listens.
                claim.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)).bind(("", int(port)))
                socket.create_server(("", int(port))).close()
            return claim.pop_all()
    except socket.gaierror as error:
        raise InputError(f"cannot reach {coordinator} ({error.strerror}); check --coordinator") from None
    except OSError as error:
        raise InputError(f"port {port} of --coordinator is not free ({error.strerror}); choose another") from None


def _difference(options: Mapping[str, Any]) -> str:
    """Describes the first difference between the processes; empty if there is none, and equal in all processes."""
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
    """Raises `ProcessLost`, with this remedy, if a collective fails because another process is lost."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        if jax.process_count() == 1 or not _OF_PEERS.search(str(error)):
            raise
        raise ProcessLost(f"another process is lost ({_first_line(error)}); {remedy}") from error


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def backend_started() -> bool:
    """Whether JAX has started a backend; the first array or list of devices starts it."""
    devices = getattr(jax.config, "jax_num_cpu_devices")  # noqa: B009  JAX defines its settings at run time
    try:
        # JAX has no public query for this, but it refuses to change the number of devices once a backend runs.
        jax.config.update("jax_num_cpu_devices", devices + 2)
        jax.config.update("jax_num_cpu_devices", devices)
    except RuntimeError:
        return True
    return False


def unusable_platform() -> str | None:
    """Returns a message if JAX cannot start the platforms in JAX_PLATFORMS, else None."""
    requested = getattr(jax.config, "jax_platforms")  # noqa: B009  as above
    try:
        jax.devices()
    except (RuntimeError, AssertionError):  # AssertionError: JAX knows the platform but has no library for it
        return (
            f"JAX cannot start '{requested}', the value of JAX_PLATFORMS, on this machine; unset it to use any "
            "available platform, or install JAX for it (pip install 'jax[cuda12]' for NVIDIA)"
        )
    return None


def double_precision_cost(rows: int = 2048) -> float:
    """Measures the time of a float64 matrix product relative to float32 on the first device; takes about a second.

    Typical values are 1 to 2 on CPUs and data-centre GPUs, and 32 or 64 on graphics cards.

    Args:
        rows: size of the square matrices; 2048 rows need 17 GFlop, which keeps any device busy.
    """

    def seconds(dtype: Any) -> float:
        square = jnp.ones((rows, rows), dtype) / rows
        # "highest" keeps float32 from being computed in fewer bits on tensor cores.
        product = jax.jit(lambda x: jnp.matmul(x, x, precision="highest")).lower(square).compile()
        jax.block_until_ready(product(square))
        times = timeit.repeat(lambda: jax.block_until_ready(product(square)), number=1, repeat=REPETITIONS)
        return statistics.median(times)

    with jax.enable_x64(True):
        return seconds(jnp.float64) / seconds(jnp.float32)


def device_lines(precision: str) -> list[str]:
    """Returns the device lines of a training's output, such as "1 gpu (NVIDIA H200)"; none on a CPU.

    Args:
        precision: "f32" or "f64"; f64 adds a line if float64 is much slower than float32 on this device.
    """
    if jax.default_backend() == "cpu":
        return []
    devices = jax.local_devices()
    kinds = sorted({device.device_kind for device in devices})
    platform = devices[0].platform
    lines = [f"{len(devices)} {platform}" + (f" ({', '.join(kinds)})" if kinds != [platform] else "")]
    if precision == "f64" and (cost := double_precision_cost()) >= EXPENSIVE:
        lines.append(
            f"float64 takes {cost:.0f} times as long as float32 on this device: Gauss-Newton and references need it, "
            "Adam does not (--precision f32); the CPU may be faster (JAX_PLATFORMS=cpu)"
        )
    return lines
