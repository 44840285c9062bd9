"""Closed loop of a plant in continuous time and a sampled controller, with the effects of the hardware on both.

At every sample the controller receives the measured coordinates and returns controls. They are limited, delayed by
whole samples and noisy, and held until the next sample while the classical Runge-Kutta method integrates the plant.
`vmap` over starts and keys simulates many runs in one program.

If a control or a measurement is not finite, the controls are NaN, and so is everything after them: a failure is never
hidden.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from dln_jax.control.finite import where_finite
from dln_jax.control.state_space import Field
from dln_jax.control.tracking import Reference, Tracker, limited
from dln_jax.mechanics.integrators import CLASSICAL, advance, runge_kutta
from dln_jax.types import InputError, require_positive


class Controller(NamedTuple):
    """A control law with memory, such as a filter, an observer or a plan; pure."""

    start: Any
    """Memory before the first sample, any tree of arrays."""
    act: Callable[[Any, Array, Array], tuple[Any, Array]]
    """(memory, t, measured y) -> (memory, u [m])."""


class Hardware(NamedTuple):
    """Limits, sensors, noise and delay between a controller and a plant; by default none."""

    least: Any = -jnp.inf
    """Lower limits of the controls [m], or one for all."""
    most: Any = jnp.inf
    encoder_step: Any = 0.0
    """Resolution to which the coordinates q are rounded, rad or m; 0 for none."""
    encoder_noise: Any = 0.0
    """Standard deviation of the noise added to q before rounding, rad or m."""
    control_noise: Any = 0.0
    """Standard deviation of the noise added to the controls after limiting."""
    delay: int = 0
    """Delay of the controls in samples."""
    sees_rates: bool = True
    """Whether the controller also receives qd, free of noise; otherwise y = q."""


class Run(NamedTuple):
    """A run of N samples."""

    t: Float[Array, "N+1"]
    x: Float[Array, "N+1 n"]
    """True states: the initial one and those at the ends of the samples."""
    u: Float[Array, "N m"]
    """Controls that acted on the plant."""
    y: Float[Array, "N p"]
    """Measurements that the controller received."""


def stateless(law: Callable[[Array], Array]) -> Controller:
    """Returns a controller without memory: y -> u."""
    return Controller((), lambda memory, t, y: (memory, law(y)))


def following(law: Tracker, reference: Reference, *, rate: float) -> Controller:
    """Returns a controller that follows a recorded reference, from measurements y = (q, qd).

    The reference is the memory of the controller, so that runs along references of one length share a program.

    Args:
        law: such as `tracking.feed_forward`.
        reference: q, qd and qdd [N, d] at the times k / rate; the last row applies to all later times.
        rate: Hz.

    Raises:
        InputError: a rate that is not positive.
    """
    require_positive(rate=rate)

    def act(reference: Reference, t: Array, y: Array) -> tuple[Reference, Array]:
        number = jnp.clip(jnp.round(t * rate).astype(int), 0, len(reference.q) - 1)
        q, qd = jnp.split(y, 2)
        return reference, law(q, qd, Reference(*(jnp.asarray(each)[number] for each in reference)))

    return Controller(reference, act)


def with_differences(
    law: Callable[[Array], Array] | Controller, d: int, *, rate: float, cutoff: float, order: int = 1
) -> Controller:
    """Estimates the rates for a law of (q, qd) from measurements of q: differences and a first-order low-pass.

    Args:
        law: (q, qd) in one vector [2 d] -> u, or a controller with such measurements.
        d: number of coordinates.
        rate: of the samples, Hz.
        cutoff: of the low-pass, Hz.
        order: of the differences; order 1 is late by half a sample, order 2 is not but amplifies the encoders' noise
            more.

    Raises:
        InputError: a rate or a cut-off that is not positive, or another order.
    """
    require_positive(rate=rate, cutoff=cutoff)
    if order not in (1, 2):
        raise InputError(f"order is {order}; expected 1 or 2")
    share = -jnp.expm1(-2 * jnp.pi * cutoff / rate)
    controller = law if isinstance(law, Controller) else stateless(law)

    def act(memory: tuple, t: Array, y: Array) -> tuple[tuple, Array]:
        (before, slope, qd, seen), inner = memory
        newest = y - before
        # The first sample has no difference, and the second no earlier one.
        rates = rate * (1.5 * newest - 0.5 * jnp.where(seen > 1, slope, newest) if order == 2 else newest)
        qd = jnp.where(seen > 0, qd + share * (rates - qd), 0.0)
        inner, u = controller.act(inner, t, jnp.concatenate([y, qd]))
        return ((y, newest, qd, jnp.minimum(seen + 1, 2)), inner), u

    return Controller(((jnp.zeros(d), jnp.zeros(d), jnp.zeros(d), jnp.asarray(0)), controller.start), act)


def simulate(
    field: Field,
    controller: Controller,
    x: Any,
    *,
    seconds: float,
    rate: float,
    controls: int,
    hardware: Hardware = Hardware(),  # noqa: B008
    key: Array | None = None,
    substeps: int = 1,
) -> Run:
    """Simulates the closed loop from a state; traceable and differentiable.

    Args:
        field: of the plant, (x, u) -> dx/dt, on x = (q, qd).
        controller: called once per sample.
        x: initial state [2 d].
        seconds: duration of the run.
        rate: of the samples, Hz.
        controls: m.
        hardware: limits, noise, delay.
        key: of the noise; required if there is any.
        substeps: integrator steps per sample.

    Raises:
        InputError: settings out of range, or noise without a key.
    """
    require_positive(seconds=seconds, rate=rate, controls=controls, substeps=substeps)
    lab = hardware
    key = noise_of(lab, key)
    samples, dt = round(seconds * rate), 1.0 / rate
    x = jnp.asarray(x, float)

    def sample(carry: tuple, number: Array) -> tuple[tuple, tuple[Array, Array, Array]]:
        x, memory, waiting = carry
        of_encoder, of_control = jax.random.split(jax.random.fold_in(key, number))
        y = measured(lab, x, of_encoder)
        memory, wanted = controller.act(memory, number * dt, y)
        u, waiting = delivered(lab, waiting, where_finite(wanted, y), of_control)
        step = runge_kutta(CLASSICAL, lambda t, state: field(state, u))
        x = advance(step, 0.0, x, dt, substeps=substeps)
        return (x, memory, waiting), (x, u, y)

    start = (x, controller.start, jnp.zeros((lab.delay, controls), x.dtype))
    _, (later, u, y) = jax.lax.scan(sample, start, jnp.arange(samples))
    return Run(dt * jnp.arange(samples + 1), jnp.concatenate([x[None], later]), u, y)


def noise_of(hardware: Hardware, key: Array | None) -> Array:
    """Returns the key, or any key without noise; raises `InputError` for noise without a key, or an invalid delay."""
    delay = hardware.delay
    if delay < 0 or delay != int(delay):
        raise InputError(f"delay is {delay}; expected a whole number of samples, 0 or more")
    if _noisy(hardware) and key is None:
        raise InputError("the hardware has noise; give a key of jax.random, a new one for each run")
    return jax.random.key(0) if key is None else key


def measured(hardware: Hardware, x: Array, key: Array) -> Array:
    """Measurement of a state (q, qd) that the controller receives."""
    q, qd = jnp.split(x, 2)
    if _noisy(hardware):
        q = q + hardware.encoder_noise * jax.random.normal(key, q.shape, x.dtype)
    y = rounded(q, hardware.encoder_step)
    return jnp.concatenate([y, qd]) if hardware.sees_rates else y


def delivered(hardware: Hardware, waiting: Array, wanted: Array, key: Array) -> tuple[Array, Array]:
    """Returns the controls that act now, and the queue [delay, m] of delayed controls after adding the wanted ones."""
    queue = jnp.concatenate([waiting, limited(wanted, hardware.least, hardware.most)[None]])
    u = queue[0]
    if _noisy(hardware):
        u = u + hardware.control_noise * jax.random.normal(key, u.shape, u.dtype)
    return u, queue[1:]


def _noisy(hardware: Hardware) -> bool:
    stated = hardware.encoder_noise, hardware.control_noise
    return any(not isinstance(each, int | float) or each != 0 for each in stated)


def rounded(q: Array, step: Any) -> Array:
    """Reading of an encoder with this resolution."""
    step = jnp.asarray(step)
    return jnp.where(step > 0, step * jnp.round(q / jnp.where(step > 0, step, 1.0)), q)
