"""Predictions of measured motions, started from a state fitted to their first samples.

The valid prediction time (see `metrics.motions`) counts from the last fitted sample.

A perturbation e of the initial state grows to e exp(lambda t), with lambda = ln |dx(T) / dx(0)| / T. Predictions of
chaotic motions are measured in Lyapunov times, 1 / lambda: a more accurate model extends them only by the logarithm of
its accuracy.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import GAP
from dln_jax.learning.shooting import START_STEPS, MeasuredWindows, nearest, phase_motion
from dln_jax.mechanics.discrete import torque_slopes
from dln_jax.mechanics.dynamics import InverseForward
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.metrics.motions import follow, valid_prediction_time
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError


class Predictions(NamedTuple):
    """Predictions of W segments of T samples."""

    q: Float[np.ndarray, "W T d"]
    qd: Float[np.ndarray, "W T d"]
    growth: Float[np.ndarray, " W"]
    """lambda, 1/s."""
    drift: Float[np.ndarray, " W"]
    """Energy drift relative to the largest kinetic energy; NaN for a model without energies."""


def cut_recordings(data: Trajectories, samples: int, *, fitted: int) -> MeasuredWindows:
    """Cuts recordings of free motions to predict; gaps are filled with unmeasured times of weight 0.

    The initial state is fitted to `fitted` consecutive samples without a gap. The first prediction starts at the first
    such place and lasts `samples` median time steps or until the recording ends. Further predictions start every half
    of that length while `samples` steps remain. Shorter segments repeat their last time, with weight 0.

    Raises:
        InputError: no recording has a sample to predict after `fitted` consecutive ones.
    """
    recordings = []
    for index in np.unique(data.trajectory):
        own = np.flatnonzero(data.trajectory == index)
        place = grid_places(data.t[own])
        last_start = -np.inf
        for first in range(len(own) - fitted):
            elapsed = place[first:] - place[first]
            whole = elapsed[-1] + 1 >= samples
            in_a_row, followed = elapsed[fitted - 1] == fitted - 1, elapsed[fitted] < samples
            apart = place[first] - last_start >= max(samples // 2, 1)
            if in_a_row and followed and ((apart and whole) or np.isinf(last_start)):
                rows = own[first:][elapsed < samples]
                recordings.append(on_grid(data.t[rows], data.q[rows], data.qd[rows]))
                last_start = place[first]
    if not recordings:
        raise InputError(f"no test motion has {fitted + 1} samples without a gap; record longer ones")
    return padded(recordings)


def cut_segments(data: Trajectories, samples: int, *, every: int) -> MeasuredWindows:
    """Cuts segments of `samples` samples to predict, starting at every `every`-th sample of the trajectories.

    Raises:
        InputError: no trajectory is long enough.
    """
    pieces = []
    for index in np.unique(data.trajectory):
        own = np.flatnonzero(data.trajectory == index)
        pieces += [own[first : first + samples] for first in range(0, len(own) - samples + 1, every)]
    if not pieces:
        raise InputError(f"no trajectory has {samples} samples to predict; record longer motions, or predict fewer")
    rows = np.stack(pieces)
    t = data.t[rows]
    return MeasuredWindows(t - t[:, :1], data.q[rows], data.qd[rows], data.tau[rows], np.ones(rows.shape))


def grid_places(t: Float[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """Returns the index of each sample on a grid of time steps; within a gap, steps are at most the median step."""
    steps = np.diff(t)
    median = np.median(steps) if len(steps) else 1.0
    # Rounding of the times must not add a step to a gap of a whole number of steps.
    counts = np.where(steps > GAP * median, np.ceil(steps / median - 1e-6), 1).astype(int)
    return np.concatenate([[0], np.cumsum(counts)])


def on_grid(t: Float[np.ndarray, " N"], q: Float[np.ndarray, "N d"], qd: Float[np.ndarray, "N d"]) -> MeasuredWindows:
    """Returns one free motion on its grid as a window; points without a sample repeat the last one with weight 0."""
    place = grid_places(t)
    grid = np.arange(place[-1] + 1)
    held = np.searchsorted(place, grid, side="right") - 1
    weight = np.isin(grid, place).astype(float)
    return MeasuredWindows(np.interp(grid, place, t - t[0]), q[held], qd[held], np.zeros_like(q[held]), weight)


def padded(motions: list[MeasuredWindows]) -> MeasuredWindows:
    """Pads motions to windows of one length: shorter ones repeat their last sample, with weight 0."""
    longest = np.arange(max(len(motion.t) for motion in motions))
    alike = (jax.tree.map(lambda array: array[np.minimum(longest, len(array) - 1)], motion) for motion in motions)
    windows = jax.tree.map(lambda *arrays: np.stack(arrays), *alike)
    return windows._replace(weight=windows.weight * [longest < len(motion.t) for motion in motions])


def predict_measured(
    model: Model,
    parameters: Parameters,
    segments: MeasuredWindows,
    *,
    fitted: int,
    substeps: int = 1,
    momenta: bool = False,
) -> Predictions:
    """Predicts motions from initial states fitted to the first `fitted` samples of q; weight 0 means unmeasured.

    Torques are interpolated between samples.

    Args:
        model: any model of energies or accelerations.
        fitted: number of samples for fitting the initial state, at least 2.
        substeps: RK4 steps between two samples.
        momenta: whether the model is a flow of (q, p) without torques and with p close to qd; p is returned as qd.

    Raises:
        InputError: `fitted` is out of range.
    """
    if not 2 <= fitted < segments.t.shape[1]:
        raise InputError(f"fitted is {fitted}; expected 2 samples or more, and fewer than the {segments.t.shape[1]}")
    spread = segments.q.reshape(-1, segments.q.shape[2]).std(axis=0)
    scale = jnp.asarray(np.where(spread > 0, spread, 1.0))
    measured = tuple(map(jnp.asarray, segments[:5]))
    return Predictions(*map(np.asarray, _predict(model, parameters, measured, scale, fitted, substeps, momenta)))


def valid_times(
    segments: MeasuredWindows,
    predicted: Predictions,
    *,
    fitted: int,
    variance: Float[np.ndarray, " d"],
) -> Float[np.ndarray, " W"]:
    """Returns the valid prediction time of each segment in s from the last fitted sample, by measured samples."""
    measured = (segments.weight > 0) & (np.arange(segments.t.shape[1]) >= fitted - 1)
    return np.array(
        [
            valid_prediction_time(q[kept], q_hat[kept], t[kept], variance)
            for q, q_hat, t, kept in zip(segments.q, predicted.q, segments.t, measured, strict=True)
        ]
    )


def prediction_metrics(
    segments: MeasuredWindows,
    predicted: Predictions,
    *,
    fitted: int,
    variance: Float[np.ndarray, " d"],
) -> dict[str, float]:
    """Returns mean and median valid prediction times over the segments, with their upper bounds.

    The entries are `vpt_seconds`, `vpt_median_seconds`, `predicted_seconds` (the duration), `energy_drift` and, if
    motions diverge, `vpt_lyapunov` (in Lyapunov times) and `lyapunov_seconds`. The model defines the Lyapunov time.
    """
    times = valid_times(segments, predicted, fitted=fitted, variance=variance)
    growth = float(np.mean(predicted.growth))
    chaotic = {"vpt_lyapunov": float(np.mean(times)) * growth, "lyapunov_seconds": 1 / growth} if growth > 0 else {}
    return {
        "vpt_seconds": float(np.mean(times)),
        "vpt_median_seconds": float(np.median(times)),
        "predicted_seconds": float(np.mean(segments.t[:, -1] - segments.t[:, fitted - 1])),
        **chaotic,
        "energy_drift": float(np.mean(predicted.drift)),
    }


# Compiled once per model and shape, for all parameters and motions.
@functools.partial(jax.jit, static_argnames=("model", "fitted", "substeps", "momenta"))
def _predict(model: Model, parameters, segments: tuple[Array, ...], scale, fitted: int, substeps: int, momenta: bool):
    energies, d = model.energies(parameters), len(scale)

    def states_and_work(start, t, tau):
        if momenta:
            return phase_motion(flow(energies), start, t, substeps=substeps), None
        slopes = torque_slopes(tau, t, "interpolated")
        motion = follow(dynamics(energies), start[:d], start[d:], tau, slopes, t, substeps=substeps)
        return jnp.concatenate([motion.q, motion.qd], axis=1), motion.work

    def one(t, q, qd, tau, weight):
        first = slice(None, fitted)

        def error(start):
            states, _ = states_and_work(start, t[first], tau[first])
            return jnp.ravel(weight[first, None] * (states[:, :d] - q[first]) / scale)

        start = nearest(error, jnp.concatenate([q[0], qd[0]]), steps=2 * START_STEPS)
        states, moves, work = jax.jvp(
            lambda start: states_and_work(start, t, tau), (start,), (jnp.ones(2 * d),), has_aux=True
        )
        growth = jnp.log(jnp.linalg.norm(moves[-1]) / jnp.linalg.norm(moves[0])) / (t[-1] - t[0])
        q, qd = states[:, :d], states[:, d:]
        if work is None or isinstance(energies, InverseForward):
            return q, qd, growth, jnp.asarray(jnp.nan)
        system = dynamics(energies)
        energy = jax.vmap(system.energy)(q, qd)
        kinetic = jax.vmap(lambda q, qd: 0.5 * qd @ system.mass_matrix(q, qd) @ qd)(q, qd)
        return q, qd, growth, jnp.max(jnp.abs(energy - energy[0] - work)) / jnp.max(kinetic)

    return jax.vmap(one)(*segments)
