"""Splits batches over the devices of one process or of all processes.

A mesh has one axis. Shared arrays, such as parameters, are replicated on every device; a batch is split along axis 0,
and a device computes its share. `spread` gathers the results in the order of the batch, so that the rest of a program
does not depend on the number of devices. A function in `on_devices` calls the collectives `total`, `mean` and `first`
itself; sums are taken in an order, and so with rounding errors, that depend on the number of devices.
Without a mesh (`None`), all of these return the function or the arrays unchanged.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import multihost_utils
from jax.extend import core
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from dln_jax.types import InputError

AXIS = "batch"
"""Name of the mesh's one axis."""
SPLIT, WHOLE = PartitionSpec(AXIS), PartitionSpec()

OfBatch = Callable[[Any, Any], Any]
"""(shared arrays, batch on axis 0 of every leaf) -> results."""


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
