"""Compensates delayed measurements: detects the delay from the first motion, and predicts the present state."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from dln_jax.control.closed_loop import Controller
from dln_jax.types import require_positive


class Late(NamedTuple):
    """Memory of a controller with prediction."""

    inner: object
    """Memory of the inner controller."""
    past: Float[Array, "most m"]
    """Past controls, newest first."""
    first: Float[Array, " p"]
    """First measurement."""
    acted: Int[Array, ""]
    """Samples since the first non-zero control, including its own; 0 before it."""
    delay: Int[Array, ""]
    """Current estimate of the measurements' delay in samples."""
    moved: Bool[Array, ""]
    """Whether motion was detected; the delay is fixed from then on."""
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
    """Wraps a controller for measurements that are late by an unknown number of samples: it acts on predictions.

    The system starts at rest. From the first non-zero control to the first measured motion there are one sample and the
    delay; until then the state is predicted from rest with all controls so far. If the system moves before its controls
    can explain it, the delay counts as zero.

    Args:
        controller: of measurements of the whole state [n].
        step: (x, u) -> x a sample later, of a model.
        states: n.
        controls: m.
        most: largest possible delay in samples.
        threshold: smallest change of a measurement that counts as motion, in its largest coordinate, for example some
            steps of an encoder.

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
