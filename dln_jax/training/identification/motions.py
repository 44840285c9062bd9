"""Identification by motions as a part of `identify`: windows of the log, the fit, and prediction times.

Motions need no accelerations. With --cutoff, their q is filtered `LIGHTER` times as high as that of torques, since the
output error does not amplify noise.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.encoders import Smoothed, smooth
from dln_jax.data.schema import Trajectories
from dln_jax.identification import equations
from dln_jax.identification.identify import Identification, parameters_of
from dln_jax.identification.motions import MotionFit, cut_motions, fit_motions
from dln_jax.metrics.measured_predictions import cut_segments, predict_measured, valid_times
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError

WINDOW = 0.3
"""Length of a window, s. Of 0.1 and 0.3 s, the longer one predicted held-out motions of a recorded double pendulum
longer."""
PUSH = 0.1
"""Standard deviation of a window's constant torque over that of a sample's torque error, which cancels in part."""
LIGHTER, NYQUIST, STEP = 5.0, 0.4, 0.01
"""Cut-off of the motions' q over that of the torques', its limit over the sampling rate, and their time step, s."""
HORIZON, EVERY = 2.2, 0.5
"""Length of a predicted segment and interval of starts, s; shorter if a held-out motion is shorter."""
FITTED = 0.1
"""Part of a segment that its initial state is fitted to, s."""


class MotionSets(NamedTuple):
    """Motions to fit, and held-out ones to predict."""

    train: Trajectories
    test: Trajectories


def lightly_filtered(data: Trajectories, filtered: Smoothed | None) -> Trajectories:
    """The log at steps of about `STEP`, with q filtered little; without --cutoff, the log itself.

    Raises:
        InputError: the light filter cuts the log into other parts.
    """
    if filtered is None:
        return data
    cutoff = min(LIGHTER * filtered.cutoff, NYQUIST * filtered.rate)
    decimate = max(1, min(round(STEP * filtered.rate), int(NYQUIST * filtered.rate / cutoff)))
    light = smooth(data, cutoff, decimate=decimate, trim=filtered.trim).data
    if light.label.tolist() != filtered.data.label.tolist():
        raise InputError("--by motions: its lighter filter cuts the log at other gaps; state a higher --cutoff in Hz")
    return light


def fit_by(
    by: str, model: Model, known: Parameters, solution: Identification, train: Trajectories, sets: MotionSets,
    window: float | None,
) -> tuple[Identification, MotionFit]:  # fmt: skip
    """The solution with parameters that fit motions, or motions and torques, and the record of that fit.

    Args:
        by: "motions" or "both".
        model: the rigid tree.
        known: its parameters in the robot's file.
        solution: consistent fit of the torques.
        train: its training data.
        sets: motions.
        window: length of the windows, s (default: `WINDOW`).

    Raises:
        InputError: physically inconsistent parameters, or a window of fewer than four samples.
    """
    if solution.consistent is None:
        raise InputError(f"--by {by} needs physically consistent bodies to simulate; leave --no-consistent out")
    length = round((WINDOW if window is None else window) / step_of(sets.train)) + 1
    if length < 4:
        raise InputError(f"--window {window} has {length} samples of the log; expected 4 at least")
    torques = None
    if by == "both":
        # Samples with correlated residuals count once, as in the standard errors.
        noise = solution.fit.noise * np.sqrt(solution.statistics.correlation)
        compact = equations.compressed(equations.regressor_of(model, parameters_of(solution.theta, known), train))
        torques = equations.weighted(compact, noise)
    fit = fit_motions(
        model, solution.columns, solution.known, solution.theta, cut_motions(sets.train, length),
        noise_tau=PUSH * solution.fit.noise, torques=torques,
    )  # fmt: skip
    kept = solution.consistent._replace(theta=fit.theta, converged=fit.converged)
    return solution._replace(consistent=kept), fit


def step_of(data: Trajectories) -> float:
    """Median time step, s."""
    steps = np.diff(data.t)[np.diff(data.trajectory) == 0]
    return float(np.median(steps))


def prediction_seconds(
    model: Model, parameters: Parameters, held: Trajectories, variance: Float[np.ndarray, " d"]
) -> tuple[float, float]:
    """Mean valid prediction time of segments of held-out motions, and the length predicted, s."""
    step, shortest = step_of(held), min(np.bincount(held.trajectory)[np.unique(held.trajectory)])
    fitted = max(3, round(FITTED / step) + 1)
    samples = max(min(round(HORIZON / step), int(shortest)), fitted + 1)
    segments = cut_segments(held, samples, every=max(1, min(round(EVERY / step), samples // 2)))
    predicted = predict_measured(model, parameters, segments, fitted=fitted)
    times = valid_times(segments, predicted, fitted=fitted, variance=variance)
    return float(np.mean(times)), (samples - fitted) * step


def prediction_metrics(
    model: Model, known: Parameters, sets: MotionSets, by_torques: np.ndarray, kept: np.ndarray, fit: MotionFit
) -> dict[str, float | int]:
    """Entries of metrics.json: prediction times of both fits, the delay, and the distance of the fitted motions."""
    variance = np.concatenate([sets.train.q, sets.test.q]).var(axis=0)
    variance = np.where(variance > 0, variance, 1.0)
    before, length = prediction_seconds(model, parameters_of(by_torques, known), sets.test, variance)
    after, _ = prediction_seconds(model, parameters_of(kept, known), sets.test, variance)
    return {
        "vpt_seconds": after, "by_torques_vpt_seconds": before, "predicted_seconds": length,
        "delay_seconds": fit.delay, "motion_rms_before": fit.before, "motion_rms": fit.after, "rounds": fit.rounds,
    }  # fmt: skip


def motion_lines(by: str, fit: MotionFit, numbers: dict[str, float | int]) -> list[str]:
    """What the fit to motions did, in three lines."""
    lines = [
        f"by {by}: windows are off by {fit.after:.3g} of their noise (before: {fit.before:.3g}; {fit.rounds} rounds)",
        f"held-out motions: predicted for {numbers['vpt_seconds']:.3g} s of {numbers['predicted_seconds']:.3g} s, by "
        f"torques alone for {numbers['by_torques_vpt_seconds']:.3g} s (mean valid prediction time)",
        f"motions follow the logged torques by {1e3 * fit.delay:.1f} ms; the model has no delay",
    ]
    return lines if fit.converged else [*lines, "the fit to motions did not converge; record motions closer to the use"]
