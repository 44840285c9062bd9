"""The fit loop: many steps per dispatch, on-device shuffling, best parameters by validation.

One dispatch runs whole epochs in a loop on the device: each epoch draws a permutation from the run's key and its own
number, so that a run that continues from a stored state takes exactly the steps of an unbroken one.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from dln_jax.types import InputError

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
    failed: Array
    """[] whether the loss or its gradient stopped being finite; the parameters are those before."""


class Record(NamedTuple):
    """What one dispatch reports, as Python numbers."""

    step: int
    loss: float
    """Mean training loss over the dispatch."""
    validation: float
    monitor: float
    """Value that is shown and never used for a choice; NaN where nothing is monitored."""


class Stop(NamedTuple):
    """Why the loop ended."""

    reason: str
    """"finished", "no improvement" or "not finite"."""
    step: int


class Fit(NamedTuple):
    """The compiled parts of a fit; see `make_fit`."""

    init: Callable[[Parameters, int], FitState]
    """(parameters, seed) -> state before the first step."""
    dispatch: Any
    """Jitted (state, epochs) -> state, [loss, validation, monitor]; the given state's buffers are used up."""
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
    validate: Callable[[Parameters], Array],
    monitor: Callable[[Parameters], Array] | None = None,
    steps_per_dispatch: int = 200,
) -> Fit:
    """Prepares a fit of `loss(parameters, batch) -> scalar` over minibatches without replacement.

    Args:
        loss: mean loss of a batch.
        optimiser: an optax transformation, its schedule included.
        train: arrays with samples on axis 0; a batch larger than that is the whole set.
        steps: steps to take, rounded up to whole epochs.
        batch: samples per step; what is left over of an epoch's permutation is not used in that epoch.
        validate: value by which the best parameters are chosen, once per dispatch.
        monitor: value to show beside it, once per dispatch.
        steps_per_dispatch: steps between two validations, rounded up to whole epochs.
    """
    samples = jax.tree.leaves(train)[0].shape[0]
    batch = min(batch, samples)
    batches = samples // batch
    epochs = -(-steps // batches)

    def step(state: FitState, indices: Array) -> tuple[FitState, Array]:
        value, gradient = jax.value_and_grad(loss)(state.parameters, jax.tree.map(lambda a: a[indices], train))
        updates, optimiser_state = optimiser.update(gradient, state.optimiser, state.parameters)
        parameters = optax.apply_updates(state.parameters, updates)
        finite = jnp.isfinite(value) & jnp.isfinite(optax.tree.norm(updates)) & ~state.failed

        def keep(new, old):
            return jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, old)

        state = state._replace(
            parameters=keep(parameters, state.parameters),
            optimiser=keep(optimiser_state, state.optimiser),
            step=state.step + finite,
            failed=~finite,
        )
        return state, value

    def run_epoch(state: FitState, _) -> tuple[FitState, Array]:
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.epoch)
        order = jax.random.permutation(key, samples)[: batches * batch].reshape(batches, batch)
        state, losses = jax.lax.scan(step, state, order)
        return state._replace(epoch=state.epoch + 1), losses.mean()

    def dispatch(state: FitState, count: Array) -> tuple[FitState, Array]:
        def body(index, carry):
            state, total = carry
            state, value = run_epoch(state, None)
            return state, total + value

        state, total = jax.lax.fori_loop(0, count, body, (state, jnp.zeros((), jnp.float32)))
        value = validate(state.parameters)
        better = (value < state.best_validation) & ~state.failed
        state = state._replace(
            best_parameters=jax.tree.map(
                lambda new, old: jnp.where(better, new, old), state.parameters, state.best_parameters
            ),
            best_validation=jnp.where(better, value, state.best_validation),
            best_step=jnp.where(better, state.step, state.best_step),
        )
        shown = jnp.nan if monitor is None else monitor(state.parameters)
        return state, jnp.stack([jnp.asarray(v, jnp.float32) for v in (total / count, value, shown)])

    def init(parameters: Parameters, seed: int) -> FitState:
        value = jnp.asarray(jnp.inf, jnp.result_type(*jax.tree.leaves(parameters)))
        return FitState(
            parameters=parameters,
            optimiser=optimiser.init(parameters),
            key=jax.random.key_data(jax.random.key(seed)),
            epoch=jnp.zeros((), jnp.int32),
            step=jnp.zeros((), jnp.int32),
            best_parameters=jax.tree.map(jnp.copy, parameters),
            best_validation=value,
            best_step=jnp.zeros((), jnp.int32),
            failed=jnp.zeros((), bool),
        )

    return Fit(
        init=init,
        dispatch=jax.jit(dispatch, donate_argnums=0),
        epochs=epochs,
        epochs_per_dispatch=min(epochs, -(-steps_per_dispatch // batches)),
    )


def run(
    fit: Fit,
    state: FitState,
    *,
    patience: int,
    on_dispatch: Callable[[FitState, Record], None],
) -> tuple[FitState, Stop]:
    """Runs a fit to its end from any state of it.

    Args:
        fit: from `make_fit`.
        state: from its `init`, or a stored one.
        patience: steps without a better validation value after which to stop.
        on_dispatch: called after every dispatch, to report and to store; the state is valid only during the call.
    """
    while int(state.epoch) < fit.epochs:
        if bool(state.failed):
            return state, Stop("not finite", int(state.step))
        if int(state.step) - int(state.best_step) >= patience:
            return state, Stop("no improvement", int(state.step))
        count = min(fit.epochs_per_dispatch, fit.epochs - int(state.epoch))
        state, values = fit.dispatch(state, count)
        loss, validation, monitor = map(float, values)
        on_dispatch(state, Record(int(state.step), loss, validation, monitor))
    return state, Stop("not finite" if bool(state.failed) else "finished", int(state.step))


def require_positive(**numbers: float) -> None:
    """Raises `InputError` that names the first number that is not positive."""
    for name, value in numbers.items():
        if not value > 0:
            raise InputError(f"{name} is {value}; expected a positive number")
