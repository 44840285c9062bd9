"""Controllers with incomplete measurements: rates from encoders, and the present state from late measurements."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from dln_jax.control.closed_loop import Controller, stateless
from dln_jax.control.state_space import Law
from dln_jax.types import InputError, require_positive


def with_differences(law: Law | Controller, d: int, *, rate: float, cutoff: float, order: int = 1) -> Controller:
    """Estimates the rates for a law of (q, qd) from measurements of q, by differences and a first-order low-pass.

    Args:
        law: (q, qd) in one vector [2 d] -> u, or a controller with such measurements.
        d: number of coordinates.
        rate: sampling rate, Hz.
        cutoff: cut-off frequency of the low-pass, Hz.
        order: order of the differences; 1 is late by half a sample, 2 is not but amplifies encoder noise more.

    A measurement that is not finite reaches the law, and the rates continue without it.

    Raises:
        InputError: the rate or the cut-off is not positive, or the order is neither 1 nor 2.
    """
    require_positive(rate=rate, cutoff=cutoff)
    if order not in (1, 2):
        raise InputError(f"order is {order}; expected 1 or 2")
    share = -jnp.expm1(-2 * jnp.pi * cutoff / rate)
    controller = law if isinstance(law, Controller) else stateless(law)

    def act(memory: tuple, t: Array, y: Array) -> tuple[tuple, Array]:
        (before, slope, qd, seen), inner = memory
        measured, y = y, jnp.where(jnp.isfinite(y), y, before + qd / rate)
        newest = y - before
        # The first sample has no difference, and the second no earlier difference.
        rates = rate * (1.5 * newest - 0.5 * jnp.where(seen > 1, slope, newest) if order == 2 else newest)
        qd = jnp.where(seen > 0, qd + share * (rates - qd), 0.0)
        inner, u = controller.act(inner, t, jnp.concatenate([measured, qd]))
        return ((y, newest, qd, jnp.minimum(seen + 1, 2)), inner), u

    return Controller(((jnp.zeros(d), jnp.zeros(d), jnp.zeros(d), jnp.asarray(0)), controller.start), act)


class Late(NamedTuple):
    """Memory of a controller with prediction."""

    inner: Any
    """Memory of the inner controller."""
    past: Float[Array, "max_delay m"]
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
    max_delay: int,
    threshold: float = 0.0,
) -> Controller:
    """Wraps a controller for measurements that are late by an unknown number of samples: it acts on predictions.

    The system starts at rest. Motion is first measured one sample plus the delay after the first non-zero control;
    until then the state is predicted from rest with all controls so far. If the system moves before its controls can
    explain it, the delay counts as zero.

    Args:
        controller: takes measurements of the whole state [n].
        step: (x, u) -> x a sample later, by a model.
        states: n, number of states.
        controls: m, number of controls.
        max_delay: largest possible delay in samples.
        threshold: smallest change of a measured coordinate that counts as motion, for example a few encoder steps.

    Raises:
        InputError: a number is not positive.
    """
    require_positive(states=states, controls=controls, max_delay=max_delay)

    def act(memory: Late, t: Array, y: Array) -> tuple[Late, Array]:
        first = jnp.where(memory.seen, memory.first, y)
        moved = memory.moved | (jnp.max(jnp.abs(y - first)) > threshold)
        on_the_way = jnp.where(moved, memory.acted - 1, memory.acted)
        delay = jnp.where(memory.moved, memory.delay, jnp.clip(on_the_way, 0, max_delay))

        x = jax.lax.fori_loop(0, delay, lambda number, x: step(x, memory.past[delay - 1 - number]), y)
        inner, u = controller.act(memory.inner, t, x)
        acted = memory.acted + ((memory.acted > 0) | jnp.any(u != 0))
        past = jnp.concatenate([u[None], memory.past[:-1]])
        return Late(inner, past, first, acted, delay, moved, jnp.ones_like(moved)), u

    zero, no, past = jnp.asarray(0), jnp.asarray(False), jnp.zeros((max_delay, controls))
    return Controller(Late(controller.start, past, jnp.zeros(states), zero, zero, no, no), act)
