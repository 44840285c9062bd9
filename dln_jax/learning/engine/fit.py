"""The fit loop: many steps per dispatch, on-device shuffling, best parameters by validation.

One dispatch runs whole epochs in one loop on the device: each epoch draws a permutation from the run's key and its own
number, so that a run that continues from a stored state takes exactly the steps of an unbroken one.
"""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from dln_jax.learning.engine.runs import Stop, plain

Parameters = Any
Data = Any
"""A pytree of arrays with samples on axis 0."""


class FitState(NamedTuple):
    """Everything that a run needs to continue."""

    parameters: Parameters
    optimiser: optax.OptState
    key: Array
    """[2] raw key data, so that it can be stored as it is."""
    epoch: Array
    """[] epochs done."""
    step: Array
    """[] steps done."""
    best_parameters: Parameters
    best_validation: Array
    """[] lowest validation value so far."""
    best_step: Array
    """[] step at which it was reached."""
    failed_step: Array
    """[] steps after which the loss was not finite, -1 while it is; the rest is the state before that dispatch."""


class Record(NamedTuple):
    """What one dispatch reports: Python numbers, or arrays [seeds]."""

    step: Any
    loss: Any
    """Mean training loss over the dispatch."""
    validation: Any
    monitor: Any
    """Value that is shown and never used for a choice."""


class Fit(NamedTuple):
    """The compiled parts of a fit; see `make_fit`."""

    init: Callable[[Parameters, Any], FitState]
    """(parameters, seed) -> state before the first step."""
    dispatch: Any
    """Jitted (state, epochs) -> state, [loss, validation, monitor]; the given state's buffers are used up.

    States with a leading axis of seeds need the fit that `over_seeds` gives."""
    start: Any
    """`init` of one seed, not jitted."""
    advance: Any
    """`dispatch` of one seed, not jitted."""
    epochs: int
    """Epochs of a whole run."""
    epochs_per_dispatch: int


def make_fit(
    loss: Callable[[Parameters, Data], Array],
    optimiser: optax.GradientTransformation,
    train: Data,
    *,
    steps: int,
    batch: int,
    score: Callable[[Parameters], tuple[Array, Array]],
    steps_per_dispatch: int = 200,
) -> Fit:
    """Prepares a fit of `loss(parameters, batch) -> scalar` over minibatches without replacement.

    Args:
        loss: mean loss of a batch.
        optimiser: an optax transformation, its schedule included.
        train: arrays with samples on axis 0; a batch larger than that is the whole set.
        steps: steps to take, rounded up to whole epochs.
        batch: samples per step; what is left over of an epoch's permutation is not used in that epoch.
        score: once per dispatch, the value by which the best parameters are chosen, and one that is only shown.
        steps_per_dispatch: steps between two validations, rounded up to whole epochs.
    """
    samples = jax.tree.leaves(train)[0].shape[0]
    batch = min(batch, samples)
    batches = samples // batch
    epochs = -(-steps // batches)

    def step(state: FitState, batch: Data) -> tuple[FitState, Array]:
        value, gradient = jax.value_and_grad(loss)(state.parameters, batch)
        updates, optimiser_state = optimiser.update(gradient, state.optimiser, state.parameters)
        state = state._replace(
            parameters=optax.apply_updates(state.parameters, updates),
            optimiser=optimiser_state,
            step=state.step + 1,
            # The first loss that is not finite; the steps after it are thrown away with the dispatch.
            failed_step=jnp.where(jnp.isfinite(value) | (state.failed_step >= 0), state.failed_step, state.step),
        )
        return state, value

    epochs_per_dispatch = min(epochs, -(-steps_per_dispatch // batches))

    def shuffled(state: FitState) -> Data:
        """The batches of a dispatch, one permutation for each of its epochs."""

        def order(epoch: Array) -> Array:
            key = jax.random.fold_in(jax.random.wrap_key_data(state.key), epoch)
            return _permutation(key, samples)[: batches * batch].reshape(batches, batch)

        orders = jax.vmap(order)(state.epoch + jnp.arange(epochs_per_dispatch)).reshape(-1, batch)
        return jax.tree.map(lambda a: a[orders], train)

    def dispatch(before: FitState, count: Array) -> tuple[FitState, Array]:
        dtype = before.best_validation.dtype
        drawn = shuffled(before)

        def body(index, carry):
            state, total = carry
            state, value = step(state, jax.tree.map(lambda a: a[index], drawn))
            return state, total + value

        # One flat loop, whose length is an argument: the last dispatch of a run may be shorter.
        total_steps = count * batches
        state, total = jax.lax.fori_loop(0, total_steps, body, (before, jnp.zeros((), dtype)))
        state = state._replace(epoch=before.epoch + count)
        finite = jnp.isfinite(optax.tree.norm(state.parameters))
        failed_step = jnp.where(finite | (state.failed_step >= 0), state.failed_step, state.step)
        # One copy a dispatch keeps the last good state, where a test after every step would slow each of them.
        state = _choose(failed_step < 0, state, before)._replace(failed_step=failed_step)
        value, shown = score(state.parameters)
        better = value < state.best_validation
        state = state._replace(
            best_parameters=_choose(better, state.parameters, state.best_parameters),
            best_validation=jnp.where(better, value, state.best_validation),
            best_step=jnp.where(better, state.step, state.best_step),
        )
        return state, jnp.stack([jnp.asarray(v, dtype) for v in (total / total_steps, value, shown)])

    def init(parameters: Parameters, seed: Any) -> FitState:
        value = jnp.asarray(jnp.inf, jnp.result_type(*jax.tree.leaves(parameters)))
        return FitState(
            parameters=parameters,
            optimiser=optimiser.init(parameters),
            key=jax.random.key_data(jax.random.key(seed)),
            epoch=jnp.zeros((), jnp.int32),
            step=jnp.zeros((), jnp.int32),
            best_parameters=parameters,
            best_validation=value,
            best_step=jnp.zeros((), jnp.int32),
            failed_step=jnp.asarray(-1, jnp.int32),
        )

    return Fit(
        init=jax.jit(init),
        dispatch=jax.jit(dispatch, donate_argnums=0),
        start=init,
        advance=dispatch,
        epochs=epochs,
        epochs_per_dispatch=epochs_per_dispatch,
    )


def over_seeds(fit: Fit) -> Fit:
    """The same fit for states with a leading axis of seeds, all in one program: init takes seeds [K] as well."""

    def init(parameters: Parameters, seeds: Array) -> FitState:
        return jax.vmap(fit.start)(parameters, seeds)

    def dispatch(states: FitState, count: Array) -> tuple[FitState, Array]:
        return jax.vmap(fit.advance, (0, None))(states, count)

    return fit._replace(init=jax.jit(init), dispatch=jax.jit(dispatch, donate_argnums=0))


def run(
    fit: Fit,
    state: FitState,
    *,
    patience: int,
    on_dispatch: Callable[[FitState, Record], None],
    seconds: float = math.inf,
) -> tuple[FitState, Stop]:
    """Runs a fit to its end from any state of it.

    Args:
        fit: from `make_fit`.
        state: from its `init`, or a stored one.
        patience: steps without a better validation value after which to stop.
        on_dispatch: called after every dispatch, to report and to store; the state is valid only during the call.
        seconds: after which to stop; looked at between dispatches, of which there is one at least.
    """
    began, dispatched = time.perf_counter(), False
    while (epoch := int(np.max(state.epoch))) < fit.epochs:
        if np.all(np.asarray(state.failed_step) >= 0):
            return state, Stop("not finite", int(np.max(state.failed_step)))
        if np.all(np.asarray(state.step - state.best_step) >= patience):
            return state, Stop("no improvement", int(np.max(state.step)))
        if dispatched and time.perf_counter() - began >= seconds:
            return state, Stop("time", int(np.max(state.step)))
        dispatched = True
        state, values = fit.dispatch(state, min(fit.epochs_per_dispatch, fit.epochs - epoch))
        if np.all(np.asarray(state.failed_step) >= 0):
            continue
        loss, validation, monitor = np.moveaxis(np.asarray(values), -1, 0)
        on_dispatch(state, Record(*map(plain, (state.step, loss, validation, monitor))))
    return state, Stop("finished", int(np.max(state.step)))


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


def _choose(condition: Array, yes: Parameters, no: Parameters) -> Parameters:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
