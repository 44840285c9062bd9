"""Noise of a process from a log, by maximum likelihood.

For innovations r with predicted variances S, the negative logarithm of the likelihood of a log is

    sum over samples and channels of  ½ (r² / S + log 2 pi S)

(Schweppe 1965). L-BFGS with central differences minimises it over the logarithms of the disturbances' deviations.
"""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.estimate.kalman import Belief, Process, belief, filtered, mechanical
from dln_jax.data.encoders.sampling import delay_held, held_at_equal_steps, noise_of, step_of, timing
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import segments
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.types import InputError, Scalar

SAMPLES = 4000
"""Number of samples taken from a log, equally many from the start of every trajectory."""
FIRST_RATE = 1.0
"""Standard deviation of the first rates, 1/s or m/s."""
DIFFERENCE = 1e-3
"""Half the step of central differences in the logarithm of a deviation."""
RANGE = math.log(1e4)
"""Largest change of a deviation's logarithm from its first value."""
ITERATIONS = 30
"""Largest number of iterations of L-BFGS."""


def tuned(process: Process, logs: list[tuple[Belief, Any, Any]]) -> Process:
    """Returns the process with the most likely disturbance for the logs.

    Args:
        process: with first values above zero.
        logs: (belief in the first state, y [N, p], u [N, m]) of every log; N may differ.

    Raises:
        InputError: there are no logs, a first value is not positive, or the likelihood is not finite.
    """
    from scipy.optimize import minimize

    first = np.asarray([] if callable(process.disturbance) else process.disturbance, float).ravel()
    if not logs or not len(first) or not (first > 0).all():
        raise InputError("tuning needs a log, and a positive constant first disturbance of every torque")
    count = sum(np.size(y) for _, y, _ in logs)
    # All logs are filtered together; shorter logs end with unseen samples.
    longest = max(len(y) for _, y, _ in logs)

    def filled(rows: Any) -> np.ndarray:
        return np.pad(np.asarray(rows), ((0, longest - len(rows)), (0, 0)))

    padded = [(x, filled(y), filled(u), (np.arange(longest) < len(y))[:, None]) for x, y, u in logs]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *padded)

    @jax.jit
    @partial(jax.vmap, in_axes=(0, None))
    def surprise(theta: Array, logs: Any) -> Scalar:
        """Returns the negative log-likelihood per measurement."""
        changed = process._replace(disturbance=jnp.asarray(first) * jnp.exp(theta))
        r, S, seen = jax.vmap(lambda log: filtered(changed, *log)[1])(logs)
        return jnp.sum(jnp.where(seen, 0.5 * (r**2 / S + jnp.log(2 * jnp.pi * S)), 0.0)) / count

    probes = DIFFERENCE * np.concatenate([np.zeros((1, len(first))), np.eye(len(first)), -np.eye(len(first))])

    def cost(theta: np.ndarray) -> tuple[float, np.ndarray]:
        # Compiling derivatives through the filter would take several times longer than computing these differences.
        values = np.asarray(surprise(jnp.asarray(theta + probes), together), float)
        above, below = np.split(values[1:], 2)
        return float(values[0]), (above - below) / (2 * DIFFERENCE)

    start = np.zeros(len(first))
    if not math.isfinite(cost(start)[0]):
        raise InputError("the likelihood of the log is not finite; check its y and u, and the model at its states")
    options = {"maxiter": ITERATIONS, "ftol": 1e-7}
    bounds = [(-RANGE, RANGE)] * len(first)
    result = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return process._replace(disturbance=np.asarray(jnp.asarray(first) * jnp.exp(jnp.asarray(result.x))))


def from_log(
    model: Dynamics | InverseForward,
    log: Trajectories,
    *,
    actuation: Any = None,
    substeps: int = 1,
    delay: int | float = 0,
) -> Process:
    """Returns the process of a model with the noise of a log of encoders and torques.

    The encoder analysis gives the noise of the coordinates, at least step / √12. The torque band starts at a hundredth
    of the range of the torques and is then tuned.

    Args:
        model: known or learned.
        log: t, q and tau; tau is held from each sample to the next, and the steps may differ.
        actuation: matrix [d, m] of the returned process.
        substeps: integrator steps per sample.
        delay: delay of the log's torques in samples.

    Raises:
        InputError: the log has no motion, or trajectories of fewer than eight samples.
    """
    log = held_at_equal_steps(log)
    rate, pieces = timing(log.t, log.trajectory).rate, segments(log.t, log.trajectory)
    noise = noise_of(log.q, np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces]))
    if not (np.isfinite(noise).all() and (noise > 0).all()):
        raise InputError(
            f"the noise of q in the log is {noise.tolist()}; expected moving coordinates and at least 8 samples"
        )
    make = partial(mechanical, model, rate=rate, encoder_noise=noise, substeps=substeps)
    first = make(band=np.full(log.q.shape[1], 0.01 * max(float(np.ptp(log.tau)), 1e-300)))
    logs, samples = [], max(SAMPLES // len(pieces), 8)
    for piece in pieces:
        q, tau = log.q[piece[:samples]], log.tau[piece[:samples]]
        start = np.concatenate([q[0], np.zeros_like(q[0])])
        deviation = np.concatenate([np.maximum(noise, step_of(log.q)), np.full(len(noise), FIRST_RATE)])
        logs.append((belief(start, deviation), jnp.asarray(q), jnp.asarray(delay_held(tau, float(delay)))))
    return make(actuation, band=tuned(first, logs).disturbance)
