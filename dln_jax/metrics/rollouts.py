"""Long predictions: a system driven by recorded torques from a recorded state, and how long it stays right.

    VPT = first t with sum_j (q_j - q_hat_j)² / var(q_j) >= threshold        (valid prediction time)
    E(t) - E(0) = work of tau - work lost to friction                        (energy balance)

Protocol: Lutter and Peters, "Combining physics and deep learning to learn continuous-time dynamics models" (2021),
integrates by RK4 at a twentieth of the samples' spacing, with the torque held over each sample. A recorded torque is
a sample of a smooth function, so that even the true plant leaves such a reference; interpolating is closer to it.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.driven import Torque, driven, torque_slopes
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.types import InputError, Vector, require_positive


class Motion(NamedTuple):
    """A predicted motion at the times of the recorded one; with a leading axis [K] for several."""

    q: Float[Array | np.ndarray, "*K T d"]
    qd: Float[Array | np.ndarray, "*K T d"]
    work: Float[Array | np.ndarray, "*K T"]
    """Energy supplied by tau less that lost to friction since the start, in J."""


def follow(
    dynamics: Dynamics | PlainDynamics,
    q0: Vector,
    qd0: Vector,
    tau: Float[Array, "T d"],
    t: Float[Array, " T"],
    *,
    substeps: int = 20,
    torque: Torque = "held",
) -> Motion:
    """The motion from (q0, qd0) under the torques tau at the times t, by RK4; one trajectory, `vmap` it over more.

    Times are in s, with any spacing; a repeated time repeats the state. There are `substeps` of RK4 per sample. The
    torque "held" keeps tau[k] until t[k + 1], as published; "interpolated" is linear in between.
    Raises InputError for no substeps, or a `torque` of another name.
    """
    require_positive(substeps=substeps)
    return _drive(dynamics, q0, qd0, tau[:-1], torque_slopes(tau, t, torque), jnp.diff(t), substeps)


def recorded_motions(
    dynamics: Dynamics | PlainDynamics,
    data: Trajectories,
    *,
    torques: Sequence[Torque] = ("held", "interpolated"),
    substeps: int = 20,
    dtype: DTypeLike | None = None,
) -> dict[Torque, list[Motion]]:
    """`follow` along every trajectory of the data, each from its first state: float64 arrays, as long as the data's.

    All kinds of torque run in one program, in `dtype` (JAX's default if not given).
    Raises InputError for a trajectory of a single sample, no substeps, or a torque of another name.
    """
    require_positive(substeps=substeps)
    groups = _samples(data)
    longest = max(map(len, groups))
    # Padded to one length by repeating the last sample: time stands still there, and so does the state.
    padded = np.stack([np.pad(group, (0, longest - len(group)), mode="edge") for group in groups])
    first = padded[:, 0]
    # Times count from the start of each trajectory before they are rounded to `dtype`.
    t = data.t[padded] - data.t[first][:, None]

    @jax.jit
    def motions(q0, qd0, tau, t):
        def drive(q0, qd0, tau, t, slopes):
            return _drive(dynamics, q0, qd0, tau[:-1], slopes, jnp.diff(t), substeps)

        slopes = jnp.stack([jax.vmap(functools.partial(torque_slopes, torque=torque))(tau, t) for torque in torques])
        return jax.vmap(lambda slopes: jax.vmap(drive)(q0, qd0, tau, t, slopes))(slopes)

    arrays = (jnp.asarray(array, dtype) for array in (data.q[first], data.qd[first], data.tau[padded], t))
    answers = [np.asarray(leaf, np.float64) for leaf in motions(*arrays)]
    return {
        torque: [Motion(*(leaf[kind, k, : len(group)] for leaf in answers)) for k, group in enumerate(groups)]
        for kind, torque in enumerate(torques)
    }


def valid_prediction_time(
    q: Float[np.ndarray, "T d"],
    q_hat: Float[np.ndarray, "T d"],
    t: Float[np.ndarray, " T"],
    variance: Float[np.ndarray, " d"],
    *,
    threshold: float = 1e-2,
) -> float:
    """Time in s from the start to the first sample with sum_j (q_j - q_hat_j)² / variance_j >= threshold.

    The whole duration if there is none. A prediction that is not finite has failed at that sample.
    """
    # A prediction that diverges may overflow on its way; inf is over the threshold, and NaN is not below it.
    with np.errstate(over="ignore", invalid="ignore"):
        failed = ~(np.sum((q - q_hat) ** 2 / variance, axis=1) < threshold)
    last = int(np.argmax(failed)) if failed.any() else len(t) - 1
    return float(t[last] - t[0])


def valid_prediction_times(
    data: Trajectories, motions: list[Motion], *, threshold: float = 1e-2
) -> Float[np.ndarray, " K"]:
    """Valid prediction time of each trajectory in s; the variance of q_j is over all samples of the data.

    Raises InputError for a coordinate that is the same in all samples, or a threshold that is not positive.
    """
    require_positive(threshold=threshold)
    variance = _variance(data.q, "q")
    return np.array(
        [
            valid_prediction_time(data.q[group], np.asarray(motion.q), data.t[group], variance, threshold=threshold)
            for group, motion in zip(_samples(data), motions, strict=True)
        ]
    )


def normalised_state_error(data: Trajectories, motions: list[Motion]) -> float:
    """Root mean square of (q - q_hat) / sd(q_j) and (qd - qd_hat) / sd(qd_j) over all samples and coordinates.

    1 is the error of a constant guess; infinite when a prediction is not finite.
    Raises InputError for a coordinate or rate that is the same in all samples.
    """
    errors = []
    for key in ("q", "qd"):
        predicted = np.concatenate([np.asarray(getattr(motion, key)) for motion in motions])
        truth = getattr(data, key)[np.concatenate(_samples(data))]
        with np.errstate(over="ignore", invalid="ignore"):
            errors.append((predicted - truth) ** 2 / _variance(getattr(data, key), key))
    return float(np.sqrt(_mean_or_infinity(np.concatenate(errors, axis=1))))


def energy_error(
    energy: Callable[[Array, Array], Array], motions: list[Motion], *, dtype: DTypeLike | None = None
) -> float:
    """Mean over all samples of |E(t) - E(0) - work(t)| in J, for the predicting system's own energy(q, qd).

    It shows what integrating costs, and whether the forward model follows from that energy; it says nothing of
    whether the energy is right. Infinite when a prediction is not finite.
    """
    states = (np.concatenate([getattr(motion, key) for motion in motions]) for key in ("q", "qd"))
    energies = np.asarray(jax.jit(jax.vmap(energy))(*(jnp.asarray(array, dtype) for array in states)), np.float64)
    bounds = np.cumsum([0] + [len(motion.work) for motion in motions])
    errors = [
        np.abs(energies[start:end] - energies[start] - motion.work)
        for motion, start, end in zip(motions, bounds[:-1], bounds[1:], strict=True)
    ]
    return _mean_or_infinity(np.concatenate(errors))


def rollout_metrics(
    dynamics: Dynamics | PlainDynamics,
    data: Trajectories,
    *,
    substeps: int = 20,
    threshold: float = 1e-2,
    dtype: DTypeLike | None = None,
) -> dict[str, float]:
    """Means over the trajectories of how well a system predicts them from their first states and torques.

    `vpt_seconds` (torque held, as published), `vpt_interpolated_seconds`, `rollout_seconds` (the duration, which bounds
    them), and of the interpolated motions, which are the more accurate, `normalised_state_error` and, of a system that
    has an energy, `energy_error_j`. The true plant's figures are the ceiling that belongs beside a model's.
    Raises InputError for a trajectory of a single sample, a coordinate that never changes, or a number not positive.
    """
    motions = recorded_motions(dynamics, data, substeps=substeps, dtype=dtype)
    held, interpolated = motions["held"], motions["interpolated"]
    durations = [data.t[group[-1]] - data.t[group[0]] for group in _samples(data)]
    metrics = {
        "vpt_seconds": float(np.mean(valid_prediction_times(data, held, threshold=threshold))),
        "vpt_interpolated_seconds": float(np.mean(valid_prediction_times(data, interpolated, threshold=threshold))),
        "rollout_seconds": float(np.mean(durations)),
        "normalised_state_error": normalised_state_error(data, interpolated),
    }
    if isinstance(dynamics, Dynamics):
        metrics["energy_error_j"] = energy_error(dynamics.energy, interpolated, dtype=dtype)
    return metrics


def _drive(dynamics: Dynamics | PlainDynamics, q0, qd0, tau, slopes, durations, substeps: int) -> Motion:
    """The motion through intervals with torque tau[k] + slopes[k] s; the work done is a third state."""

    def rate(state, tau):
        q, qd, _ = state
        # The work's rate is that of the energy: friction counts.
        at_work = tau - dynamics.friction(q, qd) if isinstance(dynamics, Dynamics) else tau
        return qd, dynamics.forward_dynamics(q, qd, tau), qd @ at_work

    return Motion(*driven(rate, (q0, qd0, jnp.zeros_like(q0[0])), tau, slopes, durations, substeps=substeps))


def _samples(data: Trajectories) -> list[np.ndarray]:
    """Indices of each trajectory's samples."""
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
