"""Adam as a stage of `fit`: many steps per dispatch, on-device shuffling, best parameters by validation.

One dispatch runs whole epochs in one loop on the device: each epoch draws a permutation from the run's key and its own
number, so that a run that continues from a stored state takes exactly the steps of an unbroken one.
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
from dln_jax.learning.engine.problem import Best, Dispatch, Problem, Stage, Stop, better_of, loss_of, no_best
from dln_jax.learning.engine.sharing import Sharing, by_devices
from dln_jax.scale.mesh import first, mean, share, shares


class State(NamedTuple):
    """Everything that a run needs to continue; with a leading axis where there are several seeds."""

    parameters: Any
    optimiser: optax.OptState
    key: Array
    """[2] raw key data, so that it can be stored as it is."""
    epoch: Array
    """[] epochs done."""
    step: Array
    """[] steps done."""
    best: Best
    failed_step: Array
    """[] steps after which the loss was not finite, -1 while it is; the rest is the state before that dispatch."""


class Lengths(NamedTuple):
    """How long a run and its parts are."""

    batch: int
    batches: int
    """Of an epoch; what is left over of its permutation is not used in it."""
    epochs: int
    epochs_per_dispatch: int


def stages(problem: Problem, adam: Adam, shared: Sharing) -> list[Stage]:
    """The one stage of a run.

    Raises:
        InputError: devices that do not divide a batch.
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

    def compile_(state: State) -> Dispatch:
        compiled = dispatch.lower(lengths.epochs_per_dispatch, state).compile()
        return lambda state: compiled(min(lengths.epochs_per_dispatch, lengths.epochs - _epoch(state)), state)

    def ended(state: State) -> Stop | None:
        if np.all(np.asarray(state.failed_step) >= 0):
            return Stop("not finite", int(np.max(state.failed_step)))
        if _epoch(state) >= lengths.epochs:
            return Stop("finished", int(np.max(state.step)))
        if np.all(np.asarray(state.step - state.best.step) >= adam.patience):
            return Stop("no improvement", int(np.max(state.step)))
        return None

    return [Stage("", lambda before: begin(problem.parameters, problem.seed), compile_, ended)]


def _epoch(state: State) -> int:
    return int(np.max(state.epoch))


def _begin(adam: Adam, parameters: Any, seed: Any) -> State:
    return State(
        parameters=parameters,
        optimiser=optimisers.transformation(adam).init(parameters),
        key=jax.random.key_data(jax.random.key(seed)),
        epoch=jnp.zeros((), jnp.int32),
        step=jnp.zeros((), jnp.int32),
        best=no_best(parameters),
        failed_step=jnp.asarray(-1, jnp.int32),
    )


def _dispatch(
    problem: Problem, adam: Adam, lengths: Lengths, mesh: Mesh | None, epochs: Array, before: State
) -> tuple[State, Array]:
    """Some epochs of one seed, and [loss, validation, monitor]; devices of a mesh share the samples of every batch."""
    dtype = before.best.validation.dtype
    loss, optimiser = loss_of(problem), optimisers.transformation(adam)
    drawn = _shuffled(problem.arrays, before, lengths, mesh)

    def step(index: Array, carry: tuple[State, Array]) -> tuple[State, Array]:
        state, total = carry
        batch = jax.tree.map(lambda a: a[index], drawn)
        value, gradient = mean(jax.value_and_grad(loss)(state.parameters, batch), mesh)
        updates, optimiser_state = optimiser.update(gradient, state.optimiser, state.parameters)
        state = state._replace(
            parameters=optax.apply_updates(state.parameters, updates),
            optimiser=optimiser_state,
            step=state.step + 1,
            # The first loss that is not finite; the steps after it are thrown away with the dispatch.
            failed_step=jnp.where(jnp.isfinite(value) | (state.failed_step >= 0), state.failed_step, state.step),
        )
        return state, total + value

    # One flat loop, whose length is an argument: the last dispatch of a run may be shorter.
    steps = epochs * lengths.batches
    state, total = jax.lax.fori_loop(0, steps, step, (before, jnp.zeros((), dtype)))
    state = state._replace(epoch=before.epoch + epochs)
    finite = jnp.isfinite(optax.tree.norm(state.parameters))
    failed_step = jnp.where(finite | (state.failed_step >= 0), state.failed_step, state.step)
    # One copy a dispatch keeps the last good state, where a test after every step would slow each of them.
    state = jax.tree.map(lambda new, old: jnp.where(failed_step < 0, new, old), state, before)
    # Devices of other makes may round otherwise: all go on from the first one's.
    state = first(state, mesh)
    value, shown = first(problem.score(state.parameters), mesh)
    best = better_of(state.best, state.parameters, value, state.step)
    values = jnp.stack([jnp.asarray(v, dtype) for v in (total / steps, value, shown)])
    return state._replace(failed_step=failed_step, best=best), values


def _shuffled(arrays: Any, state: State, lengths: Lengths, mesh: Mesh | None) -> Any:
    """The batches of a dispatch, one permutation for each of its epochs; of devices that share them each one's part."""
    samples = jax.tree.leaves(arrays)[0].shape[0]

    def order(epoch: Array) -> Array:
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), epoch)
        used = _permutation(key, samples)[: lengths.batches * lengths.batch]
        return used.reshape(lengths.batches, lengths.batch)

    orders = jax.vmap(order)(state.epoch + jnp.arange(lengths.epochs_per_dispatch)).reshape(-1, lengths.batch)
    own = share(orders, mesh, axis=1)
    return jax.tree.map(lambda a: a[own], arrays)


def _permutation(key: Array, count: int) -> Array:
    """A random order of 0..count-1.

    Up to 2^16 it sorts twice by single words, random bits above the place, four times as fast as the library sorts
    indices by random keys. What ties in one sort is in the order of the other: half a pair in 2^16 ties in both.
    """
    place_bits = max(1, (count - 1).bit_length())
    if place_bits > 16:
        return jax.random.permutation(key, count)
    words = jax.random.bits(key, (2, count), jnp.uint32) << place_bits
    ordered = jnp.sort(words | jnp.arange(count, dtype=jnp.uint32))
    first, second = (ordered & (2**place_bits - 1)).astype(jnp.int32)
    return first[second]
