"""Identification by motions as a part of `identify`: windows of the log, the fit, and prediction times.

Motions need no accelerations. With --cutoff, the cut-off of their q is `LIGHTER` times that of torques, since the
output error does not amplify noise.

The length of the windows is chosen by inner splits: fits to some trajectories (or blocks) of the training data predict
the others. The parameters fitted to torques are a candidate too, and are kept if no window predicts longer.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.data.encoders.smoothing import Smoothed, smooth
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import in_blocks, select
from dln_jax.identification import equations
from dln_jax.identification.identify import Identification, identify
from dln_jax.identification.motions import REWEIGHTINGS, MotionFit, cut_motions, fit_motions
from dln_jax.learning.linear import parameters_of
from dln_jax.metrics.predictions import cut_segments, predict_measured, valid_times
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError

WINDOWS = (0.3, 1.0)
"""Lengths of windows that inner splits choose from, s."""
FOLDS = 3
"""Inner splits, each with a third of the trajectories held out."""
PUSH = 0.1
"""Ratio of the torque bias within a window to the noise of one sample."""
LIGHTER, NYQUIST, STEP = 5.0, 0.4, 0.01
"""Cut-off of q for motions over that for torques, its largest share of the sampling rate, and their time step, s."""
HORIZON, EVERY = 2.2, 0.5
"""Length of a predicted segment and interval of starts, s; shorter if a held-out motion is shorter."""
TOGETHER = 32
"""Number of segments predicted at a time."""
FITTED = 0.1
"""Length of the first part of a segment, s, for fitting its initial state."""


def lightly_filtered(data: Trajectories, filtered: Smoothed | None) -> Trajectories:
    """The log at steps of about `STEP`, with q filtered lightly; without --cutoff, the log itself.

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


def refit(
    by: str,
    model: Model,
    known: Parameters,
    solution: Identification,
    train: Trajectories,
    motions: Trajectories,
    window: float | None,
    *,
    reweightings: int = REWEIGHTINGS,
) -> tuple[Identification, MotionFit | None]:
    """Refits the solution to motions, or to motions and torques; also returns the record of that fit.

    Args:
        by: "motions" or "both".
        known: parameters of the rigid tree in the robot's file.
        solution: consistent fit of the torques.
        motions: motions to fit, with the trajectories of `train`.
        window: length of the windows, s; `None` leaves the solution as it is.

    Raises:
        InputError: physically inconsistent parameters, or a window of fewer than four samples.
    """
    if window is None:
        return solution, None
    if solution.consistent is None:
        raise InputError(f"{by} are simulated with physically consistent bodies; fit those, by consistent=True")
    length = round(window / step_of(motions)) + 1
    if length < 4:
        raise InputError(f"--window {window} has {length} samples of the log; expected 4 at least")
    torques = None
    if by == "both":
        # Samples with correlated residuals count once, as in the standard errors.
        noise = solution.fit.noise * np.sqrt(solution.correlation)
        compact = equations.compress(equations.regressor_of(model, parameters_of(solution.theta, known), train))
        torques = equations.whiten(compact, noise)
    fit = fit_motions(
        model,
        solution.columns,
        solution.known,
        solution.theta,
        *cut_motions(motions, length),
        noise_tau=PUSH * solution.fit.noise,
        torques=torques,
        reweightings=reweightings,
    )
    consistent = solution.consistent._replace(theta=fit.theta, converged=fit.converged)
    return solution._replace(consistent=consistent), fit


def choose_window(
    by: str, model: Model, known: Parameters, train: Trajectories, motions: Trajectories, **options: Any
) -> tuple[float | None, str]:
    """Chooses a length of windows by the mean valid prediction time of inner held-out trajectories, or blocks.

    Returns the length in s, or `None` if the parameters fitted to torques predict longest, and a line on the choice. A
    length is left out if its motions are not finite. If all predict equally long, the first length is taken.

    Args:
        by, known, train, motions: as for `refit`.
        options: options of `identify`, for the fits of torques.
    """
    if len(np.unique(motions.trajectory)) == 1:
        train, motions = (in_blocks(part, 2 * FOLDS) for part in (train, motions))
    present, variance = np.unique(motions.trajectory), spread_of(motions)
    times: dict[float | None, list[np.ndarray]] = {window: [] for window in (*WINDOWS, None)}
    reason = ""
    for fold in range(min(FOLDS, len(present))):
        rest = np.delete(present, slice(fold, None, FOLDS))
        inner, moved, held = select(train, rest), select(motions, rest), select(motions, present[fold::FOLDS])
        solution = identify(model, known, inner, **options)
        for window in list(times):
            try:
                theta = refit(by, model, known, solution, inner, moved, window, reweightings=0)[0].theta
            except InputError as error:
                del times[window]
                reason = f"; other lengths were left out: {error}"
            else:
                times[window].append(prediction_times(model, parameters_of(theta, known), held, variance)[0])
    means = {window: float(np.mean(np.concatenate(parts))) for window, parts in times.items()}
    best = max(means, key=lambda window: means[window])
    names = {window: "torques" if window is None else f"{window:g} s" for window in means}
    shown = ", ".join(f"{names[window]} {mean:.3g} s" for window, mean in means.items())
    kept = "parameters by torques" if best is None else f"windows of {names[best]}"
    return best, f"chosen by cross-validation in the training data: {kept} (prediction times: {shown}){reason}"


def spread_of(*data: Trajectories) -> Float[np.ndarray, " d"]:
    """Variance of every joint's q, the unit of prediction errors; 1 for a joint that rests."""
    variance = np.concatenate([part.q for part in data]).var(axis=0)
    return np.where(variance > 0, variance, 1.0)


def step_of(data: Trajectories) -> float:
    """Median time step, s."""
    steps = np.diff(data.t)[np.diff(data.trajectory) == 0]
    return float(np.median(steps))


def prediction_times(
    model: Model, parameters: Parameters, held: Trajectories, variance: Float[np.ndarray, " d"]
) -> tuple[Float[np.ndarray, " W"], float]:
    """Valid prediction times of segments of held-out motions, and the length predicted, s."""
    step, shortest = step_of(held), min(np.bincount(held.trajectory)[np.unique(held.trajectory)])
    fitted = max(3, round(FITTED / step) + 1)
    samples = max(min(round(HORIZON / step), int(shortest)), fitted + 1)
    segments = cut_segments(held, samples, every=max(1, min(round(EVERY / step), samples // 2)))
    count = len(segments.t)
    rows = np.minimum(np.arange(-(-count // TOGETHER) * TOGETHER), count - 1)  # few shapes, so few programs
    padded = jax.tree.map(lambda array: array[rows], segments)
    predicted = predict_measured(model, parameters, padded, fitted=fitted)
    return valid_times(padded, predicted, fitted=fitted, variance=variance)[:count], (samples - fitted) * step


def motion_lines(by: str, fit: MotionFit | None, times: dict[str, float | int]) -> list[str]:
    """Lines on the fit to motions, if there is one, and on predictions of held-out motions."""
    line = (
        f"held-out motions: mean valid prediction time {times['vpt_seconds']:.3g} s of "
        f"{times['predicted_seconds']:.3g} s (fitted to torques alone: {times['by_torques_vpt_seconds']:.3g} s)"
    )
    if fit is None:
        return [line]
    lines = [
        f"fit to {by}: rms residual over noise {fit.after:.3g}, before {fit.before:.3g} ({fit.rounds} rounds)",
        line,
        f"motions follow the logged torques by {1e3 * fit.delay:.1f} ms; the model has no delay",
    ]
    return (
        lines
        if fit.converged
        else [*lines, "the fit to motions did not converge; record motions closer to the application"]
    )
