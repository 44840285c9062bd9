"""Adam as a stage of `fit`: many steps per dispatch, on-device shuffling, best parameters by validation.

A dispatch runs whole epochs in one loop on the device. The permutation of an epoch depends only on the run's key and
the epoch's number, so a resumed run takes exactly the steps of an uninterrupted one.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.sharding import Mesh

from dln_jax.learning.engine import optimisers
from dln_jax.learning.engine.optimisers import Adam
from dln_jax.learning.engine.problem import (
    Best,
    Dispatch,
    Problem,
    Sharing,
    Stage,
    Stop,
    better_of,
    by_devices,
    loss_of,
    no_best,
)
from dln_jax.scale import first, mean, share, shares


class AdamState(NamedTuple):
    """State of a run; resuming from it is exact. Several seeds add a leading axis."""

    parameters: Any
    optimiser: optax.OptState
    key: Array
    """[2] raw key data, which can be stored without conversion."""
    epoch: Array
    """[] epochs done."""
    step: Array
    """[] steps done."""
    best: Best
    failed_step: Array
    """[] steps before the first loss that was not finite, or -1. If it is set, the rest is as before the dispatch."""


class Lengths(NamedTuple):
    """Sizes of a run and of its parts."""

    batch: int
    batches: int
    """Batches per epoch; samples that do not fill a last batch are left out of that epoch."""
    epochs: int
    epochs_per_dispatch: int


def stages(problem: Problem, adam: Adam, shared: Sharing) -> list[Stage]:
    """Returns the single stage of a run.

    Raises:
        InputError: the number of devices does not divide a batch.
    """
    samples = problem.arrays[0].shape[0]
    batch = min(adam.batch, samples)
    shares(shared.samples, batch, "samples of a batch")
    batches = samples // batch
    epochs = -(-adam.steps // batches)
    lengths = Lengths(batch, batches, epochs, min(epochs, -(-adam.steps_per_dispatch // batches)))
    prepare = jax.vmap if problem.several else lambda function, *axes: function
    begin = jax.jit(prepare(lambda parameters, seed: _begin(adam, parameters, seed)))
    of_seeds = prepare(functools.partial(_dispatch, problem, adam, lengths, shared.samples), (None, 0))
    dispatch = jax.jit(by_devices(of_seeds, shared), donate_argnums=1)

    def compile_(state: AdamState) -> Dispatch:
        compiled = dispatch.lower(lengths.epochs_per_dispatch, state).compile()
        return lambda state: compiled(min(lengths.epochs_per_dispatch, lengths.epochs - _epoch(state)), state)

    def ended(state: AdamState) -> Stop | None:
        if np.all(np.asarray(state.failed_step) >= 0):
            return Stop("not finite", int(np.max(state.failed_step)))
        if _epoch(state) >= lengths.epochs:
            return Stop("finished", int(np.max(state.step)))
        if np.all(np.asarray(state.step - state.best.step) >= adam.patience):
            return Stop("no improvement", int(np.max(state.step)))
        return None

    return [Stage("", lambda before: begin(problem.parameters, problem.seed), compile_, ended)]


def _epoch(state: AdamState) -> int:
    return int(np.max(state.epoch))


def _begin(adam: Adam, parameters: Any, seed: Any) -> AdamState:
    return AdamState(
        parameters=parameters,
        optimiser=optimisers.transformation(adam).init(parameters),
        key=jax.random.key_data(jax.random.key(seed)),
        epoch=jnp.zeros((), jnp.int32),
        step=jnp.zeros((), jnp.int32),
        best=no_best(parameters),
        failed_step=jnp.asarray(-1, jnp.int32),
    )


def _dispatch(
    problem: Problem, adam: Adam, lengths: Lengths, mesh: Mesh | None, epochs: Array, before: AdamState
) -> tuple[AdamState, Array]:
    """Runs some epochs of one seed and returns [loss, validation, monitor]; devices of a mesh share every batch."""
    dtype = before.best.validation.dtype
    loss, optimiser = loss_of(problem), optimisers.transformation(adam)
    drawn = _shuffled(problem.arrays, before, lengths, mesh)

    def step(index: Array, carry: tuple[AdamState, Array]) -> tuple[AdamState, Array]:
        state, total = carry
        batch = jax.tree.map(lambda a: a[index], drawn)
        value, gradient = mean(jax.value_and_grad(loss)(state.parameters, batch), mesh)
        updates, optimiser_state = optimiser.update(gradient, state.optimiser, state.parameters)
        state = state._replace(
            parameters=optax.apply_updates(state.parameters, updates),
            optimiser=optimiser_state,
            step=state.step + 1,
            # Number of the first loss that is not finite; the steps after it are discarded with the dispatch.
            failed_step=jnp.where(jnp.isfinite(value) | (state.failed_step >= 0), state.failed_step, state.step),
        )
        return state, total + value

    # One flat loop with a traced length, because the last dispatch of a run may be shorter.
    steps = epochs * lengths.batches
    state, total = jax.lax.fori_loop(0, steps, step, (before, jnp.zeros((), dtype)))
    state = state._replace(epoch=before.epoch + epochs)
    finite = jnp.isfinite(optax.tree.norm(state.parameters))
    failed_step = jnp.where(finite | (state.failed_step >= 0), state.failed_step, state.step)
    # One copy per dispatch keeps the last good state; a test in every step would slow down the loop.
    state = jax.tree.map(lambda new, old: jnp.where(failed_step < 0, new, old), state, before)
    # Devices of different models may round differently: all continue from the state of the first.
    state = first(state, mesh)
    value, shown = first(problem.score(state.parameters), mesh)
    best = better_of(state.best, state.parameters, value, state.step)
    values = jnp.stack([jnp.asarray(v, dtype) for v in (total / steps, value, shown)])
    return state._replace(failed_step=failed_step, best=best), values


def _shuffled(arrays: Any, state: AdamState, lengths: Lengths, mesh: Mesh | None) -> Any:
    """Batches of a dispatch, with one permutation per epoch; devices that share them get their own part."""
    samples = jax.tree.leaves(arrays)[0].shape[0]

    def order(epoch: Array) -> Array:
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), epoch)
        used = _permutation(key, samples)[: lengths.batches * lengths.batch]
        return used.reshape(lengths.batches, lengths.batch)

    orders = jax.vmap(order)(state.epoch + jnp.arange(lengths.epochs_per_dispatch)).reshape(-1, lengths.batch)
    own = share(orders, mesh, axis=1)
    return jax.tree.map(lambda a: a[own], arrays)


def _permutation(key: Array, count: int) -> Array:
    """Returns a random order of 0..count-1.

    Up to 2^16 it sorts single words twice, with random bits above the index: four times as fast as
    `jax.random.permutation`. Ties in one sort keep the order of the other; at 2^16, about 0.5 pairs tie in both.
    """
    place_bits = max(1, (count - 1).bit_length())
    if place_bits > 16:
        return jax.random.permutation(key, count)
    words = jax.random.bits(key, (2, count), jnp.uint32) << place_bits
    ordered = jnp.sort(words | jnp.arange(count, dtype=jnp.uint32))
    first, second = (ordered & (2**place_bits - 1)).astype(jnp.int32)
    return first[second]
