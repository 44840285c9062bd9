"""One program on several devices and in several processes.

A mesh has one axis. Shared arrays, such as parameters, are replicated on every device; a batch is split along axis 0,
and a device computes its share. `spread` gathers the results in the order of the batch, so that the rest of a program
does not depend on the number of devices. A function in `on_devices` calls the collectives `total`, `mean` and `first`
itself; sums are taken in an order, and so with rounding errors, that depend on the number of devices. Without a mesh
(`None`), all of these return the function or the arrays unchanged.

`jax.distributed` connects the processes (`membership`, `join`), and ends them when one is lost.
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
"""Above this cost of float64, relative to float32, a user is advised to consider float32."""
AXIS = "batch"
"""Name of the mesh's one axis."""
SPLIT, WHOLE = PartitionSpec(AXIS), PartitionSpec()

OfBatch = Callable[[Any, Any], Any]
"""(shared arrays, batch on axis 0 of every leaf) -> results."""
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


def batch_mesh(devices: int | None = None) -> Mesh | None:
    """Returns the mesh of the devices that share batches, or `None` for a single device.

    Args:
        devices: number of devices of every process; default: all that JAX sees.

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
    """Returns the number of items (`what`, plural) per device; `InputError` if the devices do not divide `count`."""
    devices = 1 if mesh is None else mesh.size
    if count % devices:
        remedy = f"give a multiple of {devices}, or fewer devices"
        raise InputError(f"{count} {what} cannot be split over {devices} devices; {remedy}")
    return count // devices


def shard(tree: Any, mesh: Mesh | None) -> Any:
    """Splits arrays along axis 0; all processes pass the same whole arrays, and keep their part.

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
    """Returns process 0's value of a number that may differ between processes, such as a time."""
    if mesh is None or jax.process_count() == 1:
        return value
    # A gather over all devices reuses their connections; a broadcast would have to make others.
    return type(value)(multihost_utils.process_allgather(shard(np.full(mesh.size, value), mesh), tiled=True)[0])


def spread(function: OfBatch, mesh: Mesh | None) -> OfBatch:
    """Returns the function with the batch split over the devices; all devices get all results.

    The function must treat samples independently, as `vmap` does: a batch that the number of devices does not divide is
    padded with its first sample, whose results are dropped. The result is differentiable in forward mode; take
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
    """Runs a function on every device's share; it must return the same on all, by `total`, `mean` or `first`.

    The number of devices must divide the batch. Conditions of loops and branches with collectives must agree on all.
    """
    if mesh is None:
        return function
    # check_vma would reject loops whose length differs between devices.
    return jax.shard_map(
        _with_empty_arrays_made_inside(function), mesh=mesh, in_specs=(WHOLE, SPLIT), out_specs=WHOLE, check_vma=False
    )


def total(tree: Any, mesh: Mesh | None) -> Any:
    """Returns the sum over devices, within a function of `on_devices`."""
    return tree if mesh is None else lax.psum(tree, AXIS)


def mean(tree: Any, mesh: Mesh | None) -> Any:
    """Returns the mean over devices, within a function of `on_devices`."""
    return tree if mesh is None else lax.pmean(tree, AXIS)


def first(tree: Any, mesh: Mesh | None) -> Any:
    """Returns the first device's values, within a function of `on_devices`; other devices may round differently."""
    return tree if mesh is None else jax.tree.map(lambda leaf: lax.all_gather(leaf, AXIS)[0], tree)


def share(array: jax.Array, mesh: Mesh | None, *, axis: int) -> jax.Array:
    """Returns this device's part of a replicated array along an axis, within a function of `on_devices`."""
    if mesh is None:
        return array
    size = array.shape[axis] // mesh.size
    return lax.dynamic_slice_in_dim(array, lax.axis_index(AXIS) * size, size, axis)


def _with_empty_arrays_made_inside(function: OfBatch) -> OfBatch:
    """Returns the function with its empty arguments and constants created inside.

    XLA of jaxlib 0.11.2 removes empty inputs of a `shard_map` and crashes on the remaining ones (docs/scale.md).
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
        # Made here from this process's copy: `device_put` would compare the copies of all processes first.
        array = np.asarray(leaf)
        return jax.make_array_from_callback(array.shape, sharding, lambda index: jnp.asarray(array[index]))

    return jax.tree.map(place, tree)


Membership = tuple[str | None, int | None, int | None]
"""host:port of process 0, number of processes, and index of this one; if all are `None`, the cluster states them."""


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
    """Connects this process to the others; JAX must not have been used before.

    Args:
        member: how this process joins.
        options: JSON values by name that decide the result; they must be equal in all processes.
        seconds: time limit for the start of all processes.

    Raises:
        InputError: the address cannot be used, a process is missing, or two differ. JAX may go on connecting in a
            thread, so that the caller should end the process at once.
    """
    coordinator, processes, process = member
    where = coordinator or "the cluster"
    claim = _claimed_address(coordinator, process)
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
        count = "the processes" if processes is None else f"the {processes} processes"
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


def _claimed_address(coordinator: str | None, process: int | None) -> contextlib.ExitStack:
    """Returns what keeps other processes 0 away until it is closed.

    Raises:
        InputError: the host has no address, or the port is not free; JAX would wait in both cases.
    """
    if coordinator is None:
        return contextlib.ExitStack()
    host, _, port = coordinator.rpartition(":")
    try:
        with contextlib.ExitStack() as claim:
            if process:
                socket.getaddrinfo(host.strip("[]"), int(port))
            else:
                # JAX's servers share a port, and a process that finds another of its index aborts. The UDP port has one
                # owner until JAX listens.
                claim.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)).bind(("", int(port)))
                socket.create_server(("", int(port))).close()
            return claim.pop_all()
    except socket.gaierror as error:
        raise InputError(f"cannot reach {coordinator} ({error.strerror}); check --coordinator") from None
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


def backend_started() -> bool:
    """Returns whether JAX has started a backend, which any array or list of devices does."""
    devices = getattr(jax.config, "jax_num_cpu_devices")  # noqa: B009  JAX adds its settings as it starts
    try:
        # JAX refuses another number of devices once a backend runs: the public way to learn whether one does.
        jax.config.update("jax_num_cpu_devices", devices + 2)
        jax.config.update("jax_num_cpu_devices", devices)
    except RuntimeError:
        return True
    return False


def unusable_platform() -> str | None:
    """Returns a message if JAX cannot start the platforms that the user asks for, else None."""
    requested = getattr(jax.config, "jax_platforms")  # noqa: B009  as above
    try:
        jax.devices()
    except (RuntimeError, AssertionError):  # AssertionError: JAX knows the platform but has no library for it
        return (
            f"JAX cannot start '{requested}' here, which JAX_PLATFORMS asks for; leave it unset for what there is, "
            "or install JAX for it (pip install 'jax[cuda12]' for NVIDIA)"
        )
    return None


def double_precision_cost(rows: int = 2048) -> float:
    """Measures the time of a float64 matrix product relative to float32, on the first device, in about a second.

    Typical values are 1 to 2 on CPUs and data-centre GPUs, and 32 or 64 on graphics cards.

    Args:
        rows: size of the square matrices; 2048 rows take 17 GFlop, enough to fill any device.
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
    """Returns the lines that a training prints about its device, such as "1 gpu (NVIDIA H200)"; none on a CPU.

    Args:
        precision: "f32" or "f64"; float64 adds a line where it is much slower than float32.
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
            "networks by adam do not (--precision f32); a run may be faster on the processor (JAX_PLATFORMS=cpu)"
        )
    return lines
