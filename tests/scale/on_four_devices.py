"""Batches over four devices of one processor, against one device; a program, since the number is fixed at its start."""

import importlib
import pkgutil

import jax
import jax.numpy as jnp
import numpy as np
from calls import one_line

from dln_jax.commands import __name__, __path__
from dln_jax.scale import backend_started, batch_mesh, host_devices, on_devices, replicate, shard, shares, spread, total


def energies(scale, batch):
    """Energies of samples (x, y)."""
    x, y = batch
    return jax.vmap(lambda x, y: {"sine": jnp.sin(scale * x) @ x, "y": scale * y})(x, y)


def sums(scale, batch):
    """Sums over samples."""
    return jax.tree.map(lambda leaf: leaf.sum(0), energies(scale, batch))


jax.config.update("jax_enable_x64", True)
for module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{module.name}")
assert not backend_started()  # importing a command uses no device
host_devices(4)
assert batch_mesh(1) is None
mesh = batch_mesh()
assert mesh is not None and mesh.size == 4 and batch_mesh(2).size == 2
with one_line("--devices is 5; JAX sees 4 here"):
    batch_mesh(5)
with one_line("--devices is 0"):
    host_devices(0)
host_devices(4)  # too late, and so many

for count in (8, 5, 3):  # divided, and filled up, by less than a share and by more
    batch = (np.random.default_rng(count).normal(size=(count, 3)), np.arange(count))
    alone, together = (jax.jit(spread(energies, on))(2.0, batch) for on in (None, mesh))
    jax.tree.map(lambda one, all: np.testing.assert_allclose(one, all, rtol=1e-14, atol=1e-15), alone, together)
    slopes = [jax.jit(jax.jacfwd(lambda scale: spread(energies, on)(scale, batch)["sine"]))(2.0) for on in (None, mesh)]  # noqa: B023
    np.testing.assert_allclose(*slopes, rtol=1e-14, atol=1e-15)

batch = (np.random.default_rng(0).normal(size=(8, 3)), np.arange(8))
together = jax.jit(on_devices(lambda scale, batch: total(sums(scale, batch), mesh), mesh))(2.0, batch)
jax.tree.map(lambda one, all: np.testing.assert_allclose(one, all, rtol=1e-14), sums(2.0, batch), together)


@jax.jit
def extended(scale, batch, outer):
    """Samples times a scale, and three arrays without elements: in the batch, within a loop and closed over."""

    def of_one(longer, x, none):
        return jnp.concatenate([longer * x, none, outer])

    def of_batch(scale, batch):
        longer = jax.lax.fori_loop(0, 2, lambda _, row: jnp.concatenate([row, np.zeros(0)]), scale)
        return jax.vmap(of_one, (None, 0, 0))(longer, *batch)

    return spread(of_batch, mesh)(scale, batch)


# XLA of jaxlib 0.11.2 ends in a segmentation fault where such an array comes into a `shard_map` and is used there.
scale = np.array([1.0, 2.0, 3.0])
result = extended(scale, (batch[0], np.zeros((8, 0))), np.zeros(0))
np.testing.assert_array_equal(result, scale * batch[0])
split = shard(batch, mesh)
assert [part.data.shape for part in split[0].addressable_shards] == [(2, 3)] * 4
jax.tree.map(np.testing.assert_array_equal, split, batch)
assert backend_started()
assert replicate(batch, mesh)[0].is_fully_replicated and shares(mesh, 8, "rows") == 2
with one_line("6 seeds cannot be split over 4 devices; give a multiple of 4"):
    shares(mesh, 6, "seeds")
with one_line("cannot be split over 4 devices"):
    shard(np.zeros((6, 2)), mesh)
assert shard(batch, None) is batch and spread(energies, None) is energies
