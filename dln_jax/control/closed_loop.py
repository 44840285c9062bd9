"""Closed loop of a continuous-time plant and a sampled controller, including the effects of the hardware.

At every sample the controller receives the measured coordinates and returns controls. The loop limits them, delays them
by whole samples, adds noise and holds them until the next sample. The classical Runge-Kutta method integrates the
plant. `vmap` over starts and keys simulates many runs in one program. `outcomes` evaluates runs with a pole.

If a control or a measurement is not finite, the controls and everything after them are NaN, so no failure stays hidden.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from dln_jax.control.state_space import Field, Law, integrated, saturated, where_finite
from dln_jax.control.tracking import Reference, Tracker
from dln_jax.types import InputError, require_positive

UP = 0.1
"""Largest angle, rad, of a pole that counts as upright."""


class Controller(NamedTuple):
    """A pure control law with memory, such as a filter, an observer or a plan."""

    start: Any
    """Memory before the first sample, any tree of arrays."""
    act: Callable[[Any, Array, Array], tuple[Any, Array]]
    """(memory, t, measured y) -> (memory, u [m])."""


class Hardware(NamedTuple):
    """Limits, sensors, noise and delay between a controller and a plant; by default none."""

    lower: Any = -jnp.inf
    """Lower limits of the controls [m], or one for all."""
    upper: Any = jnp.inf
    encoder_step: Any = 0.0
    """Resolution of the encoders, rad or m: q is rounded to it; 0 for none."""
    encoder_noise: Any = 0.0
    """Standard deviation of the noise added to q before rounding, rad or m."""
    control_noise: Any = 0.0
    """Standard deviation of the noise added to the controls after limiting."""
    delay: int = 0
    """Delay of the controls in samples."""
    sees_rates: bool = True
    """True if the controller also receives qd, without noise; otherwise y = q."""


class ClosedLoopRun(NamedTuple):
    """A run of N samples."""

    t: Float[Array, "N+1"]
    x: Float[Array, "N+1 n"]
    """True states: at the start, and at the end of every sample."""
    u: Float[Array, "N m"]
    """Controls that acted on the plant."""
    y: Float[Array, "N p"]
    """Measurements that the controller received."""


class Push(NamedTuple):
    """A push: a jump of the rates, as after an impact."""

    seconds: float
    """Time of the push, s."""
    rates: Any
    """Change of the rates [d], 1/s or m/s."""


def stateless(law: Law) -> Controller:
    """Returns a controller without memory: y -> u."""
    return Controller((), lambda memory, t, y: (memory, law(y)))


def following(law: Tracker, reference: Reference, *, rate: float) -> Controller:
    """Returns a controller that follows a recorded reference, from measurements y = (q, qd).

    The reference is the memory of the controller, so runs along references of equal length share a program.

    Args:
        law: such as `tracking.feed_forward`.
        reference: q, qd and qdd [N, d] at the times k / rate; the last row applies to all later times.
        rate: sampling rate, Hz.

    Raises:
        InputError: the rate is not positive.
    """
    require_positive(rate=rate)

    def act(reference: Reference, t: Array, y: Array) -> tuple[Reference, Array]:
        number = jnp.clip(jnp.round(t * rate).astype(int), 0, len(reference.q) - 1)
        q, qd = jnp.split(y, 2)
        return reference, law(q, qd, Reference(*(jnp.asarray(column)[number] for column in reference)))

    return Controller(reference, act)


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
    substeps: int | None = 1,
    push: Push | None = None,
) -> ClosedLoopRun:
    """Simulates the closed loop from a state; traceable and differentiable.

    Args:
        field: (x, u) -> dx/dt of the plant, on x = (q, qd).
        controller: called once per sample.
        x: initial state [2 d].
        seconds: duration of the run.
        rate: sampling rate, Hz.
        controls: m, number of controls.
        hardware: limits, noise, delay.
        key: random key of the noise; required with noise.
        substeps: integrator steps per sample; `None` if `field` is a simulator (x, u) -> x one sample later.
        push: applied before the measurement of its sample; by default none.

    Raises:
        InputError: a setting is out of range, or there is noise without a key.
    """
    require_positive(seconds=seconds, rate=rate, controls=controls)
    delay, dt = hardware.delay, 1.0 / rate
    if delay < 0 or delay != int(delay):
        raise InputError(f"delay is {delay}; expected a whole number of samples, 0 or more")
    if key is None and _noisy(hardware):
        raise InputError("the hardware has noise; give a jax.random key, a new one for each run")
    key = jax.random.key(0) if key is None else key
    step = field if substeps is None else integrated(field, dt, substeps=substeps)
    x = jnp.asarray(x, float)

    def sample(carry: tuple[Array, Any, Array], number: Array) -> tuple[tuple[Array, Any, Array], tuple[Array, ...]]:
        x, memory, queue = carry
        if push is not None:
            rates = jnp.where(number == round(push.seconds * rate), jnp.asarray(push.rates, x.dtype), 0.0)
            x = x.at[len(x) // 2 :].add(rates)
        of_encoder, of_control = jax.random.split(jax.random.fold_in(key, number))
        y = measured(hardware, x, of_encoder)
        memory, command = controller.act(memory, number / rate, y)
        u, queue = delivered(hardware, queue, where_finite(command, y), of_control)
        x = step(x, u)
        return (x, memory, queue), (x, u, y)

    samples = round(seconds * rate)
    start = x, controller.start, jnp.zeros((delay, controls))
    _, (later, u, y) = jax.lax.scan(sample, start, jnp.arange(samples))
    return ClosedLoopRun(dt * jnp.arange(samples + 1), jnp.concatenate([x[None], later]), u, y)


def measured(hardware: Hardware, x: Array, key: Array) -> Array:
    """Returns the measurement of a state (q, qd) that the controller receives."""
    q, qd = jnp.split(x, 2)
    y = encoded(hardware, q, jax.random.normal(key, q.shape, x.dtype) if _noisy(hardware) else None)
    return jnp.concatenate([y, qd]) if hardware.sees_rates else y


def encoded(hardware: Hardware, q: Any, normal: Any) -> Any:
    """Returns the encoder readings of q [d]; the noise is a standard normal draw, or `None`."""
    xp = np if isinstance(q, np.ndarray) else jnp
    if normal is not None:
        q = q + hardware.encoder_noise * normal
    step = xp.asarray(hardware.encoder_step)
    return xp.where(step > 0, step * xp.round(q / xp.where(step > 0, step, 1.0)), q)


def delivered(hardware: Hardware, queue: Array, command: Array, key: Array) -> tuple[Array, Array]:
    """Returns the controls that act now, and the queue [delay, m] of delayed controls with the new command."""
    queue = jnp.concatenate([queue, saturated(command, hardware.lower, hardware.upper)[None]])
    u = queue[0]
    if _noisy(hardware):
        u = u + hardware.control_noise * jax.random.normal(key, u.shape, u.dtype)
    return u, queue[1:]


def _noisy(hardware: Hardware) -> bool:
    deviations = hardware.encoder_noise, hardware.control_noise
    return any(not isinstance(deviation, int | float) or deviation != 0 for deviation in deviations)


class Outcomes(NamedTuple):
    """Outcomes of n runs."""

    seconds: Float[np.ndarray, " n"]
    """Time in s from which the pole stays upright until the end; infinite if it does not."""
    failed: Bool[np.ndarray, " n"]
    """True for runs with non-finite values, which do not count as upright."""

    @property
    def share(self) -> float:
        """Share of the runs that end upright."""
        return float(np.mean(np.isfinite(self.seconds)))

    @property
    def median(self) -> float:
        """Median time of the runs that end upright, s; infinite without any."""
        return float(np.median(self.seconds[np.isfinite(self.seconds)])) if self.share else np.inf

    @property
    def worst(self) -> float:
        """Longest time of the runs that end upright, s; infinite without any."""
        return float(np.max(self.seconds[np.isfinite(self.seconds)])) if self.share else np.inf


def outcomes(angle: Any, *, rate: float, up: float = UP) -> Outcomes:
    """Evaluates the angles of a pole from upright [n, N+1], rad, at the samples of n runs.

    A non-finite angle does not count as upright.
    """
    angle = np.asarray(angle)
    near = np.cos(angle) > np.cos(up)  # NaN is not
    stays = near.shape[1] - np.argmin(near[:, ::-1], axis=1)
    stays = np.where(near.all(axis=1), 0, stays)
    return Outcomes(np.where(near[:, -1], stays / rate, np.inf), ~np.isfinite(angle).all(axis=1))


def hanging_starts(count: int, seed: int, *, position: float, angle: float = 0.1) -> Float[np.ndarray, "n 4"]:
    """Draws normally distributed states (position, angle from upright, rates) near a pole hanging at rest.

    Args:
        count: n.
        seed: seed of the draw.
        position: standard deviation of the driven coordinate, m or rad.
        angle: standard deviation of the pole from hanging, rad.
    """
    random = np.random.default_rng(seed)
    x = np.zeros((count, 4))
    x[:, 0] = position * random.normal(size=count)
    x[:, 1] = np.pi + angle * random.normal(size=count)
    return x
