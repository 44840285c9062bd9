"""Noise of a process from a log: the values that make its measurements most probable.

For a filter whose innovations r have the predicted variances S, the negative logarithm of the likelihood of a log is

    sum over samples and channels of  ½ (r² / S + log 2 pi S)

(Schweppe 1965). L-BFGS with central differences minimises it over the logarithms of all deviations.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.estimate.extended import extended
from dln_jax.control.estimate.loop import filtered
from dln_jax.control.estimate.process import Belief, Filter, Innovation, Process, belief, mechanical
from dln_jax.data.encoders.sampling import delay_held, held_at_equal_steps, noise_of, step_of, timing
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import segments
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.types import InputError, Scalar

SAMPLES = 4000
"""Number of samples of a log that are used, equally many from the start of every trajectory."""
FIRST_RATE = 1.0
"""Standard deviation of the first rates, 1/s or m/s."""
DIFFERENCE = 1e-3
"""Half the step of central differences in the logarithm of a deviation."""
RANGE = math.log(1e4)
"""Largest change of a deviation's logarithm from its first value."""


class Tuned(NamedTuple):
    """A process with the noise of a log."""

    process: Process
    cost: float
    """Negative log-likelihood per measurement."""
    consistency: float
    """Mean of r² / S: 1 for a correct process, above 1 for an overconfident filter."""


def surprise(innovation: Innovation) -> Scalar:
    """Returns the negative log-likelihood of innovations, in nats."""
    r, S, seen = innovation
    return jnp.sum(jnp.where(seen, 0.5 * (r**2 / S + jnp.log(2 * jnp.pi * S)), 0.0))


def consistency(innovation: Innovation) -> Scalar:
    """Returns the mean of r² / S over the measurements (normalised innovations squared)."""
    r, S, seen = innovation
    return jnp.sum(jnp.where(seen, r**2 / S, 0.0)) / jnp.maximum(jnp.sum(seen), 1)


def tuned(
    process: Process,
    logs: list[tuple[Belief, Any, Any]],
    *,
    noise: bool = False,
    make: Callable[[Process], Filter] = extended,
    iterations: int = 30,
) -> Tuned:
    """Returns the process with the disturbance, and on request the noise, that make logs most probable.

    Args:
        process: with first values above zero.
        logs: (belief in the first state, y [N, p], u [N, m]) of every log; N may differ.
        noise: whether to tune the measurement noise too; by default it is known, such as from an encoder's step.
        make: process -> filter.
        iterations: largest number of L-BFGS iterations.

    Raises:
        InputError: there are no logs, a first value is not positive, or the likelihood is not finite.
    """
    from scipy.optimize import minimize

    first = np.asarray([] if callable(process.disturbance) else process.disturbance, float).ravel()
    if not logs or not len(first) or not (first > 0).all():
        raise InputError("tuning needs a log, and a constant first disturbance above zero in every torque")
    scales = np.concatenate([first, np.ravel(np.asarray(process.noise, float))]) if noise else first
    count = sum(np.size(y) for _, y, _ in logs)

    def scaled(theta: Array) -> Process:
        values = jnp.asarray(scales) * jnp.exp(theta)
        return process._replace(
            disturbance=values[: len(first)], noise=values[len(first) :] if noise else process.noise
        )

    # All logs are filtered together; shorter ones end with samples that are not seen.
    longest = max(len(y) for _, y, _ in logs)

    def filled(rows: Any) -> np.ndarray:
        return np.pad(np.asarray(rows), ((0, longest - len(rows)), (0, 0)))

    padded = [(x, filled(y), filled(u), (np.arange(longest) < len(y))[:, None]) for x, y, u in logs]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *padded)

    def innovations(process: Process, logs: Any) -> Innovation:
        return jax.vmap(lambda log: filtered(make(process), *log)[1])(logs)

    probes = DIFFERENCE * np.concatenate([np.zeros((1, len(scales))), np.eye(len(scales)), -np.eye(len(scales))])

    @jax.jit
    @partial(jax.vmap, in_axes=(0, None))
    def surprise_of(theta: Array, logs: Any) -> Scalar:
        return surprise(innovations(scaled(theta), logs)) / count

    def cost(theta: np.ndarray) -> tuple[float, np.ndarray]:
        # Derivatives through the filter would take several times longer to compile than these differences to compute.
        values = np.asarray(surprise_of(jnp.asarray(theta + probes), together), float)
        above, below = np.split(values[1:], 2)
        return float(values[0]), (above - below) / (2 * DIFFERENCE)

    if not math.isfinite(cost(np.zeros(len(scales)))[0]):
        raise InputError("the likelihood of the log is not finite; check its y and u, and the model at its states")
    bounds = [(-RANGE, RANGE)] * len(scales)
    options = {"maxiter": iterations, "ftol": 1e-7}
    result = minimize(cost, np.zeros(len(scales)), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    best = scaled(jnp.asarray(result.x))
    best = best._replace(disturbance=np.asarray(best.disturbance), noise=np.asarray(best.noise))
    return Tuned(best, float(result.fun), float(jax.jit(lambda: consistency(innovations(best, together)))()))


def from_log(
    model: Dynamics | PlainDynamics,
    log: Trajectories,
    *,
    actuation: Any = None,
    substeps: int = 1,
    delay: int | float = 0,
) -> Tuned:
    """Returns the process of a model with the noise of a log of encoders and torques.

    The noise of the coordinates is that of the encoder analysis, at least step / √12. The torque band starts at a
    hundredth of the torques' range and is tuned.

    Args:
        model: known or learned.
        log: t, q and tau, which is held from each sample to the next; steps need not be equal.
        actuation: matrix [d, m] of the process that is returned.
        substeps: integrator steps per sample.
        delay: samples after which the log's torques act.

    Raises:
        InputError: the log has no motion, or trajectories of fewer than eight samples.
    """
    log = held_at_equal_steps(log)
    rate, pieces = timing(log.t, log.trajectory).rate, segments(log.t, log.trajectory)
    noise = noise_of(log.q, np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces]))
    if not (np.isfinite(noise).all() and (noise > 0).all()):
        raise InputError(
            f"the noise of q in the log is {noise.tolist()}; expected coordinates that move, in eight samples or more"
        )
    band = np.full(log.q.shape[1], 0.01 * max(float(np.ptp(log.tau)), 1e-300))
    first = mechanical(model, rate=rate, band=band, encoder_noise=noise, substeps=substeps)
    logs, samples = [], max(SAMPLES // len(pieces), 8)
    for piece in pieces:
        q, tau = log.q[piece[:samples]], log.tau[piece[:samples]]
        start = np.concatenate([q[0], np.zeros_like(q[0])])
        deviation = np.concatenate([np.maximum(noise, step_of(log.q)), np.full(len(noise), FIRST_RATE)])
        logs.append((belief(start, deviation), jnp.asarray(q), jnp.asarray(delay_held(tau, float(delay)))))
    result = tuned(first, logs)
    whole = mechanical(
        model, actuation, rate=rate, band=result.process.disturbance, encoder_noise=noise, substeps=substeps
    )
    return result._replace(process=whole)
