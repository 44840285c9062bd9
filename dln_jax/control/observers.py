"""Controllers with incomplete measurements: rates from encoder differences, and states from Kalman filters.

A late measurement belongs to an earlier state. The memory of `with_estimate` holds the belief at the time of the most
delayed channel, and all later measurements and controls. At every sample the filter repeats them, so each measurement
enters at its own time, and prompt channels enter at once. The law receives the state predicted for the time when its
control begins to act.

Hardware samples are never exactly on time. The filter uses their actual times: the prediction over a step of length (1
+ e) h, h = 1 / rate, is x + (1 + e) (step(x) - x), with the error ½ e (1 + e) h² d²x/dt².
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.closed_loop import Controller, stateless
from dln_jax.control.estimate.kalman import Belief, Process, belief, predict, update
from dln_jax.control.plants.plant import Layout
from dln_jax.control.state_space import Law, saturated
from dln_jax.types import InputError, require_positive

Estimator = Callable[[Law | Controller], Controller]
"""Law or controller of (q, qd) -> controller of measurements of q."""
FASTEST_FILTER = 50.0
"""Largest cut-off frequency for differences, Hz; it is also at most a quarter of the sampling rate."""
ESTIMATORS = "extended", "unscented", "differences"
"""Names of `estimator_of`."""
UNSURE = 1.0
"""Standard deviation of the first estimate: of coordinates in rad or m, and of rates in 1/s or m/s."""


def with_differences(law: Law | Controller, d: int, *, rate: float, cutoff: float, order: int = 1) -> Controller:
    """Estimates the rates for a law of (q, qd) from measurements of q, by differences and a first-order low-pass.

    Args:
        law: (q, qd) in one vector [2 d] -> u, or a controller with such measurements.
        d: number of coordinates.
        rate: sampling rate, Hz.
        cutoff: cut-off frequency of the low-pass, Hz.
        order: order of the differences. Order 1 is late by half a sample; order 2 is on time but amplifies encoder
            noise more.

    A non-finite measurement reaches the law, and the rates continue without it.

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


def with_estimate(
    law: Law | Controller,
    process: Process,
    belief: Belief,
    *,
    rate: float,
    controls: int,
    lower: Any = -jnp.inf,
    upper: Any = jnp.inf,
    delay: int | float = 0,
    late: Sequence[int] | int = 0,
    every: Sequence[int] | int = 1,
) -> Controller:
    """Returns a controller that estimates the states for a law by a Kalman filter instead of differences.

    Args:
        law: x [n] -> u, or a controller with such measurements.
        process: such as `mechanical(...)`.
        belief: belief in the state before the first measurement.
        rate: nominal sampling rate, Hz; the filter uses the times given to the controller.
        controls: m.
        lower: lower limits of the controls, for the filter.
        upper: upper limits.
        delay: delay of the controls in samples, whole or fractional.
        late: delays of the channels of y in samples, one per channel or one for all.
        every: samples between new measurements of a channel, from the first sample on, one per channel or one for all;
            values in between are ignored.

    The memory of the controller begins with the estimate of the state [n] at the last sample.

    Raises:
        InputError: a number of samples is negative, or not whole where it must be, or `every` or the rate is zero.
    """
    require_positive(rate=rate, controls=controls)
    if not 0 <= delay < jnp.inf:
        raise InputError(f"delay is {delay}; expected a number of samples, 0 or more")
    channels = len(process.measured(belief.x))
    lag, period = _samples("late", late, channels, 0), _samples("every", every, channels, 1)
    wait = int(delay)
    share = float(delay) - wait
    controller = law if isinstance(law, Controller) else stateless(law)
    window = int(lag.max()) + 1
    rows = window - 1 - lag, np.arange(channels)

    def acting(u: Array, lengths: Array) -> Array:
        """Returns the mean controls over the steps of the window, and over the steps before the next control acts."""
        lengths = jnp.concatenate([lengths, jnp.ones(wait, lengths.dtype)])
        early = jnp.cumsum(jnp.append(0.0, 1 - lengths))
        step = jnp.arange(window + wait)
        before = jnp.clip((share + early[step + wait] - early[step]) / lengths[step + wait], 0, 1)[:, None]
        return (1 - before) * u[1:] + before * u[:-1]

    def through(past: Belief, sample: tuple[Array, ...]) -> tuple[Belief, Belief]:
        y, seen, u, number, length = sample
        later = predict(process, past, u)
        later = later._replace(x=past.x + length * (later.x - past.x))
        # Before the first sample there was no motion to predict.
        later = jax.tree.map(lambda new, old: jnp.where(number > 0, new, old), later, past)
        after, _ = update(process, later, y, seen)
        return after, after

    def act(memory: tuple, t: Array, y: Array) -> tuple[tuple, Array]:
        _, inner, past, (ys, seen, queue), (number, before, lengths) = memory
        taken = number - jnp.asarray(lag)
        fresh = (taken >= 0) & (taken % jnp.asarray(period) == 0)
        ys = jnp.concatenate([ys, jnp.zeros((1, channels), y.dtype)]).at[rows].set(y)
        seen = jnp.concatenate([seen, jnp.zeros((1, channels), bool)]).at[rows].set(fresh)
        newest = jnp.where(number > 0, (t - before) * rate, 1.0).astype(ys.dtype)
        lengths = jnp.append(lengths, newest)[1:]
        known = acting(queue, lengths)
        numbers = number - window + 1 + jnp.arange(window)
        now, afterwards = jax.lax.scan(through, past, (ys, seen, known[:window], numbers, lengths[wait:]))

        none = jnp.zeros_like(process.deviation(now.x, jnp.zeros(controls, now.x.dtype)))
        ahead = now.x
        for u in known[window:]:
            ahead = process.step(ahead, u, none)
        if share:
            ahead += share * (process.step(ahead, queue[-1], none) - ahead)
        inner, u = controller.act(inner, t, ahead)
        u = saturated(u, lower, upper)
        past = jax.tree.map(lambda leaf: leaf[0], afterwards)
        recent = ys[1:], seen[1:], jnp.concatenate([queue[1:], u[None]])
        return (now.x, inner, past, recent, (number + 1, jnp.asarray(t, ys.dtype), lengths)), u

    zeros = lambda *shape: jnp.zeros(shape, belief.x.dtype)  # noqa: E731
    unseen = jnp.zeros((window - 1, channels), bool)
    recent = zeros(window - 1, channels), unseen, zeros(window + wait + 1, controls)
    clock = jnp.asarray(0), zeros(), jnp.ones(window + wait, belief.x.dtype)
    return Controller((belief.x, controller.start, belief, recent, clock), act)


def _samples(name: str, value: Any, count: int, least: int) -> np.ndarray:
    numbers = np.broadcast_to(np.asarray(value), (count,))
    if not (np.equal(numbers, np.round(numbers)) & (numbers >= least)).all():
        raise InputError(f"{name} is {value}; expected whole numbers of samples, {least} or more")
    return numbers.astype(int)


def require_estimator(name: str) -> None:
    """Raises `InputError` for a name that is not one of `ESTIMATORS`."""
    if name not in ESTIMATORS:
        raise InputError(f"estimator is {name!r:.40}; choose from {', '.join(ESTIMATORS)}")


def by_differences(layout: Layout) -> Estimator:
    """Returns an estimator of the rates by differences of the measurements and a low-pass."""
    cutoff = min(FASTEST_FILTER, layout.rate / 4)
    return lambda law: with_differences(law, len(layout.joints), rate=layout.rate, cutoff=cutoff)


def by_filter(layout: Layout, process: Process, *, delay: int | float = 0) -> Estimator:
    """Returns an estimator of the states by a filter that uses the times of the measurements.

    Args:
        layout: layout of the plant.
        process: for example from `estimate.from_log`.
        delay: samples after which a control begins to act.
    """
    lower, upper = layout.limits.control.T
    d, m = layout.actuation.shape
    start = belief(np.concatenate([layout.hanging, np.zeros(d)]), np.full(2 * d, UNSURE))
    return lambda law: with_estimate(
        law, process, start, rate=layout.rate, controls=m, lower=lower, upper=upper, delay=delay
    )


def estimator_of(name: str, layout: Layout, process: Process | None, *, delay: int | float) -> Estimator:
    """Returns the estimator with a name.

    Args:
        name: one of `ESTIMATORS`.
        layout: layout of the plant.
        process: for the filters.
        delay: samples after which a control begins to act.

    Raises:
        InputError: the name is unknown, or a filter has no process.
    """
    require_estimator(name)
    if name == "differences":
        return by_differences(layout)
    if process is None:
        raise InputError(f"the filter {name!r} needs a process, for example from estimate.from_log")
    return by_filter(layout, process._replace(unscented=name == "unscented"), delay=delay)
