"""Measurements that come late: how late is seen when the system first moves; a model predicts what has come since."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from dln_jax.control.closed_loop import Controller
from dln_jax.types import require_positive


class Late(NamedTuple):
    """Memory of a controller that predicts."""

    inner: object
    """Of the controller that is asked."""
    past: Float[Array, "most m"]
    """Controls, the newest first."""
    first: Float[Array, " p"]
    """Measurement."""
    acted: Int[Array, ""]
    """Samples since the first control that was not zero, that one included; 0 before it."""
    delay: Int[Array, ""]
    """Samples by which measurements are late, as far as is known."""
    moved: Bool[Array, ""]
    """Whether the system was seen to move, from when on the delay stays."""
    seen: Bool[Array, ""]


def with_prediction(
    controller: Controller,
    step: Callable[[Array, Array], Array],
    *,
    states: int,
    controls: int,
    most: int,
    threshold: float = 0.0,
) -> Controller:
    """A controller that is asked about the state of now, where measurements are late by a number of samples.

    The system starts at rest. From the first control that is not zero to the first measurement of motion there is one
    sample and the delay; until then, what was asked for so far is predicted from rest. A system that moves by itself
    before, or sooner than its controls say, is taken not to be late.

    Args:
        controller: of measurements of the whole state [n].
        step: (x, u) -> x a sample later, of a model.
        states: n.
        controls: m.
        most: samples of delay that may be.
        threshold: of a measurement's change, in its largest coordinate, above which it is motion, such as some steps of
            an encoder.

    Raises:
        InputError: a number that is not positive.
    """
    require_positive(states=states, controls=controls, most=most)

    def act(memory: Late, t: Array, y: Array) -> tuple[Late, Array]:
        first = jnp.where(memory.seen, memory.first, y)
        moved = memory.moved | (jnp.max(jnp.abs(y - first)) > threshold)
        on_the_way = jnp.where(moved, memory.acted - 1, memory.acted)
        delay = jnp.where(memory.moved, memory.delay, jnp.clip(on_the_way, 0, most))

        x = jax.lax.fori_loop(0, delay, lambda number, x: step(x, memory.past[delay - 1 - number]), y)
        inner, u = controller.act(memory.inner, t, x)
        acted = memory.acted + ((memory.acted > 0) | jnp.any(u != 0))
        past = jnp.concatenate([u[None], memory.past[:-1]])
        return Late(inner, past, first, acted, delay, moved, jnp.ones_like(moved)), u

    none, no = jnp.asarray(0), jnp.asarray(False)
    return Controller(Late(controller.start, jnp.zeros((most, controls)), jnp.zeros(states), none, none, no, no), act)
