"""Filters in closed loops and over logs: late measurements, several rates, and controls on their way to the motors.

A late measurement belongs to an earlier state. The memory holds the belief at the time of the most delayed channel, and
the measurements and controls since then. At every sample the filter goes through them again, so that each measurement
is used at its own time, and prompt channels at once. The law receives the state predicted for the moment at which its
control begins to act.

Samples of hardware are never exactly on time. With the nominal rate, the filter uses their own times: the prediction
over a step of length (1 + e) h, h = 1 / rate, is x + (1 + e) (step(x) - x), with the error ½ e (1 + e) h² d²x/dt².
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from dln_jax.control.closed_loop import Controller, stateless
from dln_jax.control.estimate.process import Belief, Filter, Innovation
from dln_jax.control.state_space import Law, saturated
from dln_jax.types import InputError, require_positive


class Estimating(NamedTuple):
    """Memory of a controller with a filter."""

    x: Float[Array, " n"]
    """Estimate of the state at the last sample."""
    inner: Any
    """Memory of the inner controller."""
    filter: Any
    """Memory of the filter D samples ago, before the measurement at that time."""
    y: Float[Array, "D p"]
    """Measurements of the last D samples by the time that they belong to, oldest first."""
    seen: Bool[Array, "D p"]
    u: Float[Array, "D+delay m"]
    """Controls that act from D samples ago on, oldest first."""
    number: Int[Array, ""]
    """Samples so far."""
    t: Any = None
    """Time of the last sample, s; `None` if samples count as evenly spaced."""
    lengths: Any = None
    """Lengths of the last D + delay steps, in nominal steps, oldest first."""
    before: Any = None
    """Estimate before the prediction to `filter`, if no channel is late."""


def with_estimate(
    law: Law | Controller,
    filter: Filter,
    belief: Belief,
    *,
    controls: int,
    measurements: int,
    lower: Any = -jnp.inf,
    upper: Any = jnp.inf,
    delay: int | float = 0,
    late: Sequence[int] | int = 0,
    every: Sequence[int] | int = 1,
    rate: float | None = None,
) -> Controller:
    """Gives a law the states that a filter estimates from measurements, instead of differences of encoder readings.

    Args:
        law: x [n] -> u, or a controller with such measurements.
        filter: such as `extended(process)`.
        belief: belief in the state before the first measurement.
        controls: m.
        measurements: p.
        lower: lower limits of the controls, which the filter must know.
        upper: upper limits.
        delay: samples after which a control begins to act; it need not be a whole number.
        late: delays of the channels of y in samples, one per channel or one for all.
        every: samples between new measurements of a channel, from the first sample on, one per channel or one for all;
            values in between are ignored.
        rate: nominal sampling rate, Hz. With it the filter uses the times with which the controller is called;
            by default samples count as evenly spaced.

    Raises:
        InputError: a number of samples is negative, or not whole where it must be, or `every` or the rate is zero.
    """
    if rate is not None:
        require_positive(rate=rate)
    require_positive(controls=controls, measurements=measurements)
    lag, period = _samples("late", late, measurements, 0), _samples("every", every, measurements, 1)
    if not 0 <= delay < jnp.inf:
        raise InputError(f"delay is {delay}; expected a number of samples, 0 or more")
    wait = int(delay)
    share = float(delay) - wait
    controller = law if isinstance(law, Controller) else stateless(law)
    depth = int(lag.max())
    rows = depth - lag, np.arange(measurements)
    queued = wait + (share > 0 or rate is not None)

    def shares_of(lengths: Any) -> Any:
        """Returns the shares of D past steps and of later ones in which the control before still acts."""
        if rate is None:
            return jnp.full(depth + wait + 1, share)
        lengths = jnp.concatenate([lengths, jnp.ones(wait + 1, lengths.dtype)])
        early = jnp.cumsum(jnp.append(0.0, 1 - lengths))
        step = jnp.arange(depth + wait + 1)
        return jnp.clip((share + early[step + wait] - early[step]) / lengths[step + wait], 0, 1)

    def acting(u: Array, shares: Array) -> Array:
        """Returns the mean control over each step."""
        shares = shares[: len(u) - 1, None]
        return (1 - shares) * u[1:] + shares * u[:-1] if queued > wait else u

    def act(memory: Estimating, t: Array, y: Array) -> tuple[Estimating, Array]:
        taken = memory.number - jnp.asarray(lag)
        fresh = (taken >= 0) & (taken % jnp.asarray(period) == 0)
        ys = jnp.concatenate([memory.y, jnp.zeros((1, measurements), y.dtype)]).at[rows].set(y)
        seen = jnp.concatenate([memory.seen, jnp.zeros((1, measurements), bool)]).at[rows].set(fresh)

        def through(past: Any, sample: tuple[Any, ...]) -> tuple[Any, Any]:
            y, seen, u, number, length = sample
            updated, _ = filter.update(past, y, seen)
            later = stretched(updated.x, filter.predict(updated, u), length)
            # Before the first sample there was no motion to predict.
            later = jax.tree.map(lambda new, old: jnp.where(number >= 0, new, old), later, past)
            return later, later

        base, lengths, newest = memory.filter, None, None
        if rate is not None:
            newest = jnp.where(memory.number > 0, (t - memory.t) * rate, 1.0).astype(ys.dtype)
            # One length in, one out: without delays there is none to keep.
            lengths = jnp.append(memory.lengths, newest)[1:]
        shares = shares_of(lengths)
        known = acting(memory.u, shares)
        if depth:
            numbers = memory.number - depth + jnp.arange(depth)
            past_lengths = None if lengths is None else lengths[wait:]
            past, afterwards = jax.lax.scan(through, base, (ys[:-1], seen[:-1], known[:depth], numbers, past_lengths))
            base = jax.tree.map(lambda leaf: leaf[0], afterwards)
        else:
            past = stretched(memory.before, base, newest)
        past, _ = filter.update(past, ys[-1], seen[-1])
        ahead = past.x
        for number in range(wait):
            ahead = filter.process.step(ahead, known[depth + number], jnp.zeros_like(nothing(past.x)))
        if share:
            ahead += share * (filter.process.step(ahead, memory.u[-1], jnp.zeros_like(nothing(past.x))) - ahead)
        inner, u = controller.act(memory.inner, t, ahead)
        u = saturated(u, lower, upper)
        queue = jnp.concatenate([memory.u, u[None]])
        if not depth:
            base = filter.predict(past, acting(queue, shares)[0])
        timed = {} if rate is None else {"t": jnp.asarray(t, ys.dtype), "lengths": lengths, "before": past.x}
        return Estimating(past.x, inner, base, ys[1:], seen[1:], queue[1:], memory.number + 1, **timed), u

    def stretched(x: Any, later: Any, length: Any) -> Any:
        """Returns the memory that was predicted from x over a nominal step, over a step of another length."""
        return later if length is None else later._replace(x=x + length * (later.x - x))

    def nothing(x: Array) -> Array:
        return filter.process.deviation(x, jnp.zeros(controls, x.dtype))

    zeros = lambda *shape: jnp.zeros(shape, belief.x.dtype)  # noqa: E731
    start = Estimating(
        belief.x, controller.start, filter.start(belief), zeros(depth, measurements),
        jnp.zeros((depth, measurements), bool), zeros(depth + queued, controls), jnp.asarray(0),
    )  # fmt: skip
    if rate is not None:
        start = start._replace(t=zeros(), lengths=jnp.ones(depth + wait, belief.x.dtype), before=belief.x)
    return Controller(start, act)


def filtered(
    filter: Filter, belief: Belief, y: Float[Array, "N p"], u: Float[Array, "N m"], seen: Any = True
) -> tuple[Float[Array, "N n"], Innovation]:
    """Filters a log: returns estimates of the states at its samples, and the innovations [N, p]; pure.

    Args:
        filter: such as `extended(process)`.
        belief: belief in the state before the first measurement.
        y: measurements.
        u: controls that act from each sample to the next.
        seen: which channels have a measurement at a sample, [N, p], [p] or one for all.
    """
    y = jnp.asarray(y)
    seen = jnp.broadcast_to(jnp.asarray(seen, bool), y.shape)

    def sample(memory: Any, row: tuple[Array, Array, Array]) -> tuple[Any, tuple[Array, Innovation]]:
        y, u, seen = row
        memory, innovation = filter.update(memory, y, seen)
        return filter.predict(memory, u), (memory.x, innovation)

    return jax.lax.scan(sample, filter.start(belief), (y, jnp.asarray(u), seen))[1]


def _samples(name: str, value: Any, count: int, least: int) -> np.ndarray:
    numbers = np.broadcast_to(np.asarray(value), (count,))
    if not (np.equal(numbers, np.round(numbers)) & (numbers >= least)).all():
        raise InputError(f"{name} is {value}; expected whole numbers of samples, {least} or more")
    return numbers.astype(int)
