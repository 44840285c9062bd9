"""Predicted motions under recorded torques: the time until they fail, and their energy.

    VPT = first t with sum_j (q_j - q_hat_j)² / var(q_j) >= THRESHOLD        (valid prediction time)
    E(t) - E(0) = work of tau - work lost to friction                        (energy balance)

Motions start from a recorded state; `metrics.predictions` fits the start to measured coordinates.

Protocol: Lutter and Peters, "Combining physics and deep learning to learn continuous-time dynamics models" (2021),
integrate by RK4 with twenty steps per sample and hold the torque over each sample. A recorded torque, however, is a
sample of a smooth function, so even the true plant deviates under held torques. Interpolation is more accurate.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.discrete import Torque, driven, torque_slopes
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.mechanics.integrators import looped_rk4
from dln_jax.metrics.phase_space import finite_or_infinite
from dln_jax.types import InputError, Vector, require_positive

TORQUES: tuple[Torque, ...] = ("held", "interpolated")
"""Torque between two samples; both kinds are evaluated."""
SUBSTEPS = 20
"""RK4 steps per sample, as published."""
THRESHOLD = 1e-2
"""A prediction has failed if its squared error over the variance, summed over coordinates, reaches this value, as
published."""


class Motion(NamedTuple):
    """A predicted motion at the times of the recorded one; K motions add a leading axis."""

    q: Float[Array | np.ndarray, "*K T d"]
    qd: Float[Array | np.ndarray, "*K T d"]
    work: Float[Array | np.ndarray, "*K T"]
    """Work of tau since the start minus the energy lost to friction, J."""


def follow(
    dynamics: Dynamics | InverseForward,
    q0: Vector,
    qd0: Vector,
    tau: Float[Array, "T d"],
    slopes: Float[Array, "T-1 d"],
    t: Float[Array, " T"],
    *,
    substeps: int = SUBSTEPS,
) -> Motion:
    """Integrates the motion from (q0, qd0) under torques by RK4; `vmap` it over trajectories.

    The torque is tau[k] + slopes[k] (t - t[k]) from t[k] on, with slopes from `torque_slopes`. Times in s may have any
    spacing; a repeated time repeats the state. Each sample takes `substeps` RK4 steps.

    Raises:
        InputError: `substeps` is not positive.
    """
    require_positive(substeps=substeps)

    def rate(state, tau):
        q, qd, _ = state
        # The work changes at the rate of the energy, including friction.
        at_work = tau - dynamics.friction(q, qd) if isinstance(dynamics, Dynamics) else tau
        return qd, dynamics.forward_dynamics(q, qd, tau), qd @ at_work

    start = q0, qd0, jnp.zeros_like(q0[0])
    return Motion(*driven(rate, start, tau[:-1], slopes, jnp.diff(t), substeps=substeps, method=looped_rk4))


def motion_program(
    dynamics_of: Callable[[Any], Dynamics | InverseForward],
) -> Callable[[Any, tuple[Array, ...]], tuple[Motion, Array | None]]:
    """Returns (parameters, records) -> motions and their energies, for `jax.jit`; leading axes [TORQUES, trajectories].

    Energies (J) are computed by the predicting system at its own states; `None` for a system without energy. Parameters
    are arguments, not constants, so one compilation serves every seed.
    """

    def motions(parameters: Any, records: tuple[Array, ...]) -> tuple[Motion, Array | None]:
        dynamics = dynamics_of(parameters)
        q0, qd0, tau, t = records

        def drive(q0, qd0, tau, t, slopes):
            motion = follow(dynamics, q0, qd0, tau, slopes, t)
            energy = jax.vmap(dynamics.energy)(motion.q, motion.qd) if isinstance(dynamics, Dynamics) else None
            return motion, energy

        slopes = jnp.stack([jax.vmap(functools.partial(torque_slopes, torque=torque))(tau, t) for torque in TORQUES])
        return jax.vmap(lambda slopes: jax.vmap(drive)(q0, qd0, tau, t, slopes))(slopes)

    return motions


def records_of(data: Trajectories, dtype: DTypeLike | None) -> tuple[Array, ...]:
    """Returns the records of K trajectories for a `motion_program`, in `dtype` (JAX's default if `None`).

    The records are the first q and qd [K, d], tau [K, T, d], and the times [K, T] since the start of the trajectory in
    s. The last samples are repeated to pad all trajectories to one length T.

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
    return tuple(jnp.asarray(array, dtype) for array in (data.q[first], data.qd[first], data.tau[padded], t))


def by_trajectory(motions: Motion, data: Trajectories) -> dict[Torque, list[Motion]]:
    """Returns the motions of a `motion_program` as float64 arrays of their own lengths."""
    groups, arrays = _samples(data), [np.asarray(leaf, np.float64) for leaf in motions]
    return {
        torque: [Motion(*(leaf[kind, k, : len(group)] for leaf in arrays)) for k, group in enumerate(groups)]
        for kind, torque in enumerate(TORQUES)
    }


def valid_prediction_time(
    q: Float[np.ndarray, "T d"],
    q_hat: Float[np.ndarray, "T d"],
    t: Float[np.ndarray, " T"],
    variance: Float[np.ndarray, " d"],
) -> float:
    """Returns the time in s from the start to the first sample with sum_j (q_j - q_hat_j)² / variance_j >= THRESHOLD.

    If there is none, returns the whole duration. A prediction that is not finite has failed at that sample.
    """
    # A diverging prediction may overflow; infinity exceeds the threshold, and NaN is not below it.
    with np.errstate(over="ignore", invalid="ignore"):
        failed = ~(np.sum((q - q_hat) ** 2 / variance, axis=1) < THRESHOLD)
    last = int(np.argmax(failed)) if failed.any() else len(t) - 1
    return float(t[last] - t[0])


def valid_prediction_times(data: Trajectories, motions: list[Motion]) -> Float[np.ndarray, " K"]:
    """Returns the valid prediction time of each trajectory in s, with the variance of q_j over all samples of the data.

    Raises:
        InputError: a coordinate is the same in all samples.
    """
    variance = _variance(data.q, "q")
    return np.array(
        [
            valid_prediction_time(data.q[group], np.asarray(motion.q), data.t[group], variance)
            for group, motion in zip(_samples(data), motions, strict=True)
        ]
    )


def normalised_state_error(data: Trajectories, motions: list[Motion]) -> float:
    """Returns the root mean square of (q - q_hat) / sd(q_j) and (qd - qd_hat) / sd(qd_j) over samples and coordinates.

    A constant guess has an error of 1. The error is infinite if a prediction is not finite.

    Raises:
        InputError: a coordinate or rate is the same in all samples.
    """
    errors, samples = [], np.concatenate(_samples(data))
    for key in ("q", "qd"):
        predicted, true = np.concatenate([getattr(motion, key) for motion in motions]), getattr(data, key)
        with np.errstate(over="ignore", invalid="ignore"):
            errors.append((predicted - true[samples]) ** 2 / _variance(true, key))
    return float(np.sqrt(finite_or_infinite(np.mean(np.concatenate(errors, axis=1)))))


def metrics_of_motions(motions: Motion, energies: Array | None, data: Trajectories) -> dict[str, float]:
    """Returns means over trajectories for the motions and energies of a `motion_program`, with both kinds of torque.

    The entries are `vpt_seconds` (torque held, as published), `vpt_interpolated_seconds` and `rollout_seconds` (the
    duration, an upper bound of both). The interpolated motions, which are more accurate, also give
    `normalised_state_error` and, if the system has an energy, `energy_error_j`: the mean over all samples of
    |E(t) - E(0) - work(t)|, infinite if a prediction is not finite. It measures the integration error and whether the
    forward model is consistent with the energy, but not whether the energy is correct. The numbers of the true plant
    are the best that a model can reach.

    Raises:
        InputError: a coordinate never changes.
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
        metrics["energy_error_j"] = float(finite_or_infinite(np.mean(np.concatenate(imbalances))))
    return metrics


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
