"""Predictions of motions under recorded torques, the time until they fail, and their energy.

    VPT = first t with sum_j (q_j - q_hat_j)² / var(q_j) >= threshold        (valid prediction time)
    E(t) - E(0) = work of tau - work lost to friction                        (energy balance)

Motions start from a recorded state (`motion_program`) or, for measured coordinates, from a state that is fitted to
their first samples (`predict_measured`); the VPT then counts from the last of these.

Protocol: Lutter and Peters, "Combining physics and deep learning to learn continuous-time dynamics models" (2021),
integrate by RK4 at a twentieth of the samples' spacing, with the torque held over each sample. But a recorded torque is
a sample of a smooth function, so even the true plant deviates under held torques; interpolation is more accurate.

A perturbation e of the initial state grows to e exp(lambda t), with lambda = ln |dx(T) / dx(0)| / T. Predictions of
chaotic motions are measured in Lyapunov times, 1 / lambda: a more accurate model extends them only by the logarithm of
its accuracy.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import GAP
from dln_jax.learning.shooting import START_STEPS, MeasuredWindows, nearest, phase_motion
from dln_jax.mechanics.discrete import Torque, driven, torque_slopes
from dln_jax.mechanics.dynamics import Dynamics, InverseForward, PlainDynamics
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.mechanics.integrators import looped_rk4
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, Vector, require_positive

TORQUES: tuple[Torque, ...] = ("held", "interpolated")
"""Kinds of torque between two samples; all are compared."""
SUBSTEPS = 20
"""RK4 steps per sample, as published."""


class Motion(NamedTuple):
    """A predicted motion at the times of the recorded one; several add a leading axis [K]."""

    q: Float[Array | np.ndarray, "*K T d"]
    qd: Float[Array | np.ndarray, "*K T d"]
    work: Float[Array | np.ndarray, "*K T"]
    """Energy supplied by tau minus the loss to friction since the start, in J."""


class Records(NamedTuple):
    """Records of K trajectories, padded to one length T by repeating their last samples."""

    q0: Float[Array, "K d"]
    qd0: Float[Array, "K d"]
    tau: Float[Array, "K T d"]
    t: Float[Array, "K T"]
    """Time since the start of the trajectory, in s."""


class Predictions(NamedTuple):
    """Predictions of W segments of T samples."""

    q: Float[np.ndarray, "W T d"]
    qd: Float[np.ndarray, "W T d"]
    growth: Float[np.ndarray, " W"]
    """lambda, 1/s."""
    drift: Float[np.ndarray, " W"]
    """Energy drift relative to the largest kinetic energy; NaN for a model without energies."""


def follow(
    dynamics: Dynamics | PlainDynamics,
    q0: Vector,
    qd0: Vector,
    tau: Float[Array, "T d"],
    t: Float[Array, " T"],
    *,
    substeps: int = SUBSTEPS,
    torque: Torque = "held",
) -> Motion:
    """Integrates the motion from (q0, qd0) under the torques tau at the times t by RK4; `vmap` it over trajectories.

    Times are in s, with any spacing; a repeated time repeats the state. There are `substeps` RK4 steps per sample. The
    torque "held" keeps tau[k] until t[k + 1], as published; "interpolated" is linear in between.

    Raises InputError if `substeps` is not positive or `torque` has another name.
    """
    require_positive(substeps=substeps)
    return _drive(dynamics, q0, qd0, tau, torque_slopes(tau, t, torque), t, substeps)


def motion_program(
    dynamics_of: Callable[[Any], Dynamics | PlainDynamics],
) -> Callable[[Any, Records], tuple[Motion, Array | None]]:
    """Returns (parameters, records) -> motions and their energies, for `jax.jit`; leading axes [TORQUES, trajectories].

    Energies, in J, are those of the predicting system at its own states; `None` for a system without energy. Parameters
    are arguments of the program, not constants in it, so one compilation serves every seed.
    """

    def motions(parameters: Any, records: Records) -> tuple[Motion, Array | None]:
        dynamics = dynamics_of(parameters)
        q0, qd0, tau, t = records

        def drive(q0, qd0, tau, t, slopes):
            motion = _drive(dynamics, q0, qd0, tau, slopes, t, SUBSTEPS)
            energy = jax.vmap(dynamics.energy)(motion.q, motion.qd) if isinstance(dynamics, Dynamics) else None
            return motion, energy

        slopes = jnp.stack([jax.vmap(functools.partial(torque_slopes, torque=torque))(tau, t) for torque in TORQUES])
        return jax.vmap(lambda slopes: jax.vmap(drive)(q0, qd0, tau, t, slopes))(slopes)

    return motions


def records_of(data: Trajectories, dtype: DTypeLike | None) -> Records:
    """Returns the records for a `motion_program`, in `dtype` (JAX's default if `None`).

    Raises:
        InputError: a trajectory has a single sample.
    """
    groups = _samples(data)
    longest = max(map(len, groups))
    # Padded to one length by repeating the last sample: with time steps of zero, the state stays there.
    padded = np.stack([np.pad(group, (0, longest - len(group)), mode="edge") for group in groups])
    first = padded[:, 0]
    # Times are counted from the start of a trajectory before they are rounded to `dtype`.
    t = data.t[padded] - data.t[first][:, None]
    return Records(*(jnp.asarray(array, dtype) for array in (data.q[first], data.qd[first], data.tau[padded], t)))


def by_trajectory(motions: Motion, data: Trajectories) -> dict[Torque, list[Motion]]:
    """Returns the motions of a `motion_program` as float64 arrays of their own lengths."""
    groups, arrays = _samples(data), [np.asarray(leaf, np.float64) for leaf in motions]
    return {
        torque: [Motion(*(leaf[kind, k, : len(group)] for leaf in arrays)) for k, group in enumerate(groups)]
        for kind, torque in enumerate(TORQUES)
    }


def cut_recordings(data: Trajectories, samples: int, *, fitted: int) -> MeasuredWindows:
    """Cuts recordings of free motions to predict; gaps are filled with unmeasured times of weight 0.

    An initial state is fitted to `fitted` consecutive samples without a gap. A recording is predicted from the first
    such place, for `samples` median time steps or until it ends. Further predictions start at intervals of half that
    length, as long as `samples` steps remain. Shorter segments repeat their last time, with weight 0.

    Raises:
        InputError: no recording has more than `fitted` consecutive samples, so that there is one to predict.
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


def grid_places(t: Float[np.ndarray, " N"], *, gap: float = GAP) -> Int[np.ndarray, " N"]:
    """Returns the samples' indices on a grid of their own time steps; within a gap, steps are at most the median."""
    steps = np.diff(t)
    median = np.median(steps) if len(steps) else 1.0
    # Rounding of the times must not add a step to a gap of an integer number of steps.
    counts = np.where(steps > gap * median, np.ceil(steps / median - 1e-6), 1).astype(int)
    return np.concatenate([[0], np.cumsum(counts)])


def on_grid(t: Float[np.ndarray, " N"], q: Float[np.ndarray, "N d"], qd: Float[np.ndarray, "N d"]) -> MeasuredWindows:
    """Returns one free motion on the grid of its places, as a window; places of weight 0 repeat the previous sample."""
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
    torque: Torque = "interpolated",
    substeps: int = 1,
    momenta: bool = False,
) -> Predictions:
    """Predicts motions from initial states fitted to the first `fitted` samples of q; weight 0 means unmeasured.

    Args:
        model: a model of any energies, or of accelerations.
        fitted: number of samples for fitting the initial state, at least 2.
        torque: torque between samples, "held" or "interpolated".
        substeps: RK4 steps between two samples.
        momenta: whether the model is a flow of (q, p), without torques, with p close to qd; its p is returned as qd.

    Raises:
        InputError: `fitted` is out of range.
    """
    if not 2 <= fitted < segments.t.shape[1]:
        raise InputError(f"fitted is {fitted}; expected 2 samples or more, and fewer than the {segments.t.shape[1]}")
    spread = segments.q.reshape(-1, segments.q.shape[2]).std(axis=0)
    scale = jnp.asarray(np.where(spread > 0, spread, 1.0))
    options = {"scale": scale, "fitted": fitted, "torque": torque, "substeps": substeps, "momenta": momenta}
    predicted = _predict(model, parameters, *map(jnp.asarray, segments[:5]), **options)
    return Predictions(*map(np.asarray, predicted))


def valid_prediction_time(
    q: Float[np.ndarray, "T d"],
    q_hat: Float[np.ndarray, "T d"],
    t: Float[np.ndarray, " T"],
    variance: Float[np.ndarray, " d"],
    *,
    threshold: float = 1e-2,
) -> float:
    """Returns the time in s from the start to the first sample with sum_j (q_j - q_hat_j)² / variance_j >= threshold.

    If there is none, returns the whole duration. A prediction that is not finite has failed at that sample.
    """
    # A diverging prediction may overflow; infinity exceeds the threshold, and NaN is not below it.
    with np.errstate(over="ignore", invalid="ignore"):
        failed = ~(np.sum((q - q_hat) ** 2 / variance, axis=1) < threshold)
    last = int(np.argmax(failed)) if failed.any() else len(t) - 1
    return float(t[last] - t[0])


def valid_prediction_times(
    data: Trajectories, motions: list[Motion], *, threshold: float = 1e-2
) -> Float[np.ndarray, " K"]:
    """Returns the trajectories' valid prediction times in s; the variance of q_j is over all samples of the data.

    Raises InputError if a coordinate is the same in all samples, or the threshold is not positive.
    """
    require_positive(threshold=threshold)
    variance = _variance(data.q, "q")
    return np.array(
        [
            valid_prediction_time(data.q[group], np.asarray(motion.q), data.t[group], variance, threshold=threshold)
            for group, motion in zip(_samples(data), motions, strict=True)
        ]
    )


def valid_times(
    segments: MeasuredWindows,
    predicted: Predictions,
    *,
    fitted: int,
    variance: Float[np.ndarray, " d"],
) -> Float[np.ndarray, " W"]:
    """Returns the segments' valid prediction times in s from the last fitted sample on, at measured samples."""
    measured = (segments.weight > 0) & (np.arange(segments.t.shape[1]) >= fitted - 1)
    return np.array(
        [
            valid_prediction_time(q[kept], q_hat[kept], t[kept], variance)
            for q, q_hat, t, kept in zip(segments.q, predicted.q, segments.t, measured, strict=True)
        ]
    )


def normalised_state_error(data: Trajectories, motions: list[Motion]) -> float:
    """Returns the root mean square of (q - q_hat) / sd(q_j) and (qd - qd_hat) / sd(qd_j) over samples and coordinates.

    1 is the error of a constant guess; infinite if a prediction is not finite. Raises InputError if a coordinate or
    rate is the same in all samples.
    """
    errors, samples = [], np.concatenate(_samples(data))
    for key in ("q", "qd"):
        predicted, true = np.concatenate([getattr(motion, key) for motion in motions]), getattr(data, key)
        with np.errstate(over="ignore", invalid="ignore"):
            errors.append((predicted - true[samples]) ** 2 / _variance(true, key))
    return float(np.sqrt(_mean_or_infinity(np.concatenate(errors, axis=1))))


def metrics_of_motions(motions: Motion, energies: Array | None, data: Trajectories) -> dict[str, float]:
    """Returns means over the trajectories of the motions and energies of a `motion_program`, for both kinds of torque.

    `vpt_seconds` (torque held, as published), `vpt_interpolated_seconds` and `rollout_seconds` (the duration, which
    bounds them). For the interpolated motions, which are more accurate, also `normalised_state_error` and, if the
    system has an energy, `energy_error_j`: the mean over all samples of |E(t) - E(0) - work(t)|, infinite if a
    prediction is not finite. It shows the integration error, and whether the forward model is consistent with that
    energy, but not whether the energy is right. The figures of the true plant bound a model's.

    Raises InputError if a coordinate never changes.
    """
    held, interpolated = by_trajectory(motions, data).values()
    metrics = {
        "vpt_seconds": float(np.mean(valid_prediction_times(data, held))),
        "vpt_interpolated_seconds": float(np.mean(valid_prediction_times(data, interpolated))),
        "rollout_seconds": float(np.mean([np.ptp(data.t[group]) for group in _samples(data)])),
        "normalised_state_error": normalised_state_error(data, interpolated),
    }
    if energies is not None:
        pairs = zip(np.asarray(energies, np.float64)[1], (motion.work for motion in interpolated), strict=True)
        imbalances = [abs(energy[: len(work)] - energy[0] - work) for energy, work in pairs]
        metrics["energy_error_j"] = _mean_or_infinity(np.concatenate(imbalances))
    return metrics


def prediction_metrics(
    segments: MeasuredWindows,
    predicted: Predictions,
    *,
    fitted: int,
    variance: Float[np.ndarray, " d"],
) -> dict[str, float]:
    """Returns means over the segments, the median valid prediction time, and upper bounds on these times.

    `vpt_seconds`, `vpt_median_seconds`, `predicted_seconds` (the duration), `vpt_lyapunov` (in Lyapunov times, if
    motions diverge) and `lyapunov_seconds`, by the model's own growth of small changes; `energy_drift`.
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


def _drive(dynamics: Dynamics | PlainDynamics, q0, qd0, tau, slopes, t, substeps: int) -> Motion:
    """Integrates with the torque tau[k] + slopes[k] (t - t[k]) from t[k] on; the work done is a third state."""

    def rate(state, tau):
        q, qd, _ = state
        # The work changes at the rate of the energy, including friction.
        at_work = tau - dynamics.friction(q, qd) if isinstance(dynamics, Dynamics) else tau
        return qd, dynamics.forward_dynamics(q, qd, tau), qd @ at_work

    start = q0, qd0, jnp.zeros_like(q0[0])
    return Motion(*driven(rate, start, tau[:-1], slopes, jnp.diff(t), substeps=substeps, method=looped_rk4))


# Compiled once per model and shape, for all parameters and motions.
@functools.partial(jax.jit, static_argnames=("model", "fitted", "torque", "substeps", "momenta"))
def _predict(
    model: Model, parameters, t, q, qd, tau, weight, *, scale, fitted: int, torque: Torque, substeps: int, momenta
):
    energies = model.energies(parameters)
    d = q.shape[2]

    def states_and_work(start, t, tau):
        if momenta:
            return phase_motion(flow(energies), start, t, substeps=substeps), None
        motion = follow(dynamics(energies), start[:d], start[d:], tau, t, substeps=substeps, torque=torque)
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

    return jax.vmap(one)(t, q, qd, tau, weight)


def _samples(data: Trajectories) -> list[np.ndarray]:
    groups = [np.flatnonzero(data.trajectory == index) for index in np.unique(data.trajectory)]
    if not groups:
        raise InputError("there are no trajectories; a rollout needs at least one")
    for group in groups:
        if len(group) < 2:
            name = data.label[data.trajectory[group[0]]]
            raise InputError(f"trajectory '{name}' has 1 sample; a rollout needs at least 2: choose recorded motions")
    return groups


def _variance(values: np.ndarray, key: str) -> np.ndarray:
    variance = np.var(values, axis=0)
    if not (variance > 0).all():
        column = int(np.argmin(variance > 0))
        raise InputError(f"{key}[:, {column}] is the same in all samples; errors cannot be measured in its variance")
    return variance


def _mean_or_infinity(errors: np.ndarray) -> float:
    mean = float(np.mean(errors))
    return mean if np.isfinite(mean) else float("inf")
