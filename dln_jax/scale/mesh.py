"""Batches split over the devices of one process, or of all.

A mesh has one axis. What is shared, such as parameters, lies whole on every device; a batch is split along axis 0, and
each device works at its share. `spread` brings the results together again, in the order of the batch, so that what is
done with them afterwards is the same program on any number of devices; `summed` adds them up, whose order, and so the
rounding, depends on their number. A function of `on_devices` does that itself, wherever it needs to: by `total`,
`mean` and `first`. Where there is no mesh (`None`), all are the function or the arrays themselves.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from dln_jax.types import InputError

AXIS = "batch"
"""Name of the mesh's one axis."""
SPLIT, WHOLE = PartitionSpec(AXIS), PartitionSpec()

OfBatch = Callable[[Any, Any], Any]
"""(what is shared, a batch on axis 0 of every leaf) -> results."""


def batch_mesh(devices: int | None = None) -> Mesh | None:
    """The devices that share batches, `None` where that is one alone.

    Args:
        devices: how many of every process (default: all that JAX sees).

    Raises:
        InputError: a process has fewer.
    """
    local = jax.local_device_count()
    count = local if devices is None else devices
    if not 1 <= count <= local:
        raise InputError(f"--devices is {count}; JAX sees {local} here ({jax.default_backend()}), give 1 to {local}")
    by_process = [jax.local_devices(process_index=process)[:count] for process in range(jax.process_count())]
    chosen = np.array([device for of_one in by_process for device in of_one])
    return Mesh(chosen, (AXIS,)) if len(chosen) > 1 else None


def shares(mesh: Mesh | None, count: int, what: str) -> int:
    """How many of `count` each device has.

    Raises:
        InputError: they cannot be divided; `what` names them, in the plural.
    """
    devices = 1 if mesh is None else mesh.size
    if count % devices:
        remedy = f"give a multiple of {devices}, or fewer devices"
        raise InputError(f"{count} {what} cannot be split over {devices} devices; {remedy}")
    return count // devices


def shard(tree: Any, mesh: Mesh | None) -> Any:
    """Arrays split along axis 0; every process gives the same whole ones, and keeps its part.

    Raises:
        InputError: the mesh does not divide an axis.
    """
    if mesh is None:
        return tree
    for leaf in jax.tree.leaves(tree):
        shares(mesh, np.shape(leaf)[0], "rows of an array")
    return _placed(tree, NamedSharding(mesh, SPLIT))


def replicate(tree: Any, mesh: Mesh | None) -> Any:
    """Arrays that lie whole on every device; every process gives the same."""
    return tree if mesh is None else _placed(tree, NamedSharding(mesh, WHOLE))


def gathered(tree: Any) -> Any:
    """The same arrays, whole and readable in every process."""

    def whole(leaf: Any) -> Any:
        split = isinstance(leaf, jax.Array) and not (leaf.is_fully_addressable or leaf.is_fully_replicated)
        if not split:
            return leaf
        return _gathering(leaf.sharding.mesh)(leaf)  # pyright: ignore[reportAttributeAccessIssue]

    return jax.tree.map(whole, tree)


def program(function: Callable[..., Any], mesh: Mesh | None, **options: Any) -> Any:
    """`jax.jit` of a function whose arguments and results lie whole on every device of the mesh.

    Arguments may be arrays of this process alone, if every process gives the same. `options` are those of `jax.jit`.
    """
    whole = {} if mesh is None else dict.fromkeys(("in_shardings", "out_shardings"), NamedSharding(mesh, WHOLE))
    return jax.jit(function, **whole, **options)


def local(tree: Any, mesh: Mesh | None) -> Any:
    """Copies of arrays that lie whole on every device, on this process's first device alone."""
    return tree if mesh is None else jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), tree)


def of_first_process(value: bool | float, mesh: Mesh | None) -> bool | float:
    """A number that processes may see differently, such as a time, as the first one sees it."""
    if mesh is None:
        return value
    # Through the connections of all devices together, which are there: others would have to be made, at one time.
    return type(value)(np.asarray(gathered(shard(np.full(mesh.size, value), mesh)))[0])


def spread(function: OfBatch, mesh: Mesh | None) -> OfBatch:
    """The same function, each device on its share of the batch; every device has all results.

    The function treats the samples of a batch as strangers, as `vmap` does: a batch that the mesh does not divide is
    filled up with its first sample, whose results are dropped. Differentiable in forward mode; take reverse mode inside
    of it.
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


def summed(function: OfBatch, mesh: Mesh | None) -> OfBatch:
    """A function whose results are sums over the batch, each device on its share; every device has the whole sums.

    The mesh divides the batch. Take derivatives inside of it.
    """
    return on_devices(lambda shared, batch: total(function(shared, batch), mesh), mesh)


def on_devices(function: OfBatch, mesh: Mesh | None) -> OfBatch:
    """A function that each device works out on its share, and that gives the same on all by `total`, `mean` or `first`.

    The mesh divides the batch. Where loops or branches bring anything together, their conditions must agree.
    """
    if mesh is None:
        return function
    # Loops of different length on each device have no types in common over the mesh: what varies is not checked.
    return jax.shard_map(
        _with_empty_arrays_made_inside(function), mesh=mesh, in_specs=(WHOLE, SPLIT), out_specs=WHOLE, check_vma=False
    )


def total(tree: Any, mesh: Mesh | None) -> Any:
    """Within a function of `on_devices`: the sum over devices."""
    return tree if mesh is None else lax.psum(tree, AXIS)


def mean(tree: Any, mesh: Mesh | None) -> Any:
    """Within a function of `on_devices`: the mean over devices."""
    return tree if mesh is None else lax.pmean(tree, AXIS)


def first(tree: Any, mesh: Mesh | None) -> Any:
    """Within a function of `on_devices`: what the first device has; others may have rounded otherwise."""
    return tree if mesh is None else jax.tree.map(lambda leaf: lax.all_gather(leaf, AXIS)[0], tree)


def share(array: jax.Array, mesh: Mesh | None, *, axis: int) -> jax.Array:
    """Within a function of `on_devices`: this device's part of an array that is whole, along an axis."""
    if mesh is None:
        return array
    size = array.shape[axis] // mesh.size
    return lax.dynamic_slice_in_dim(array, lax.axis_index(AXIS) * size, size, axis)


@functools.cache
def _gathering(mesh: Mesh) -> Callable[[jax.Array], jax.Array]:
    return jax.jit(lambda x: x, out_shardings=NamedSharding(mesh, WHOLE))


def _with_empty_arrays_made_inside(function: OfBatch) -> OfBatch:
    """The same function, which reads no array without elements from outside: neither an argument nor a constant.

    XLA of jaxlib 0.11.2 removes such an input of a `shard_map` and crashes on those that are left (docs/scale.md).
    """

    def on_one(shared: Any, batch: Any) -> Any:
        arguments = _made_if_empty((shared, batch))
        # Tracing brings to light what the function has closed over, in its loops too.
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
