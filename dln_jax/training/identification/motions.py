"""Identification by motions as a part of `identify`: windows of the log, the fit, and prediction times.

Motions need no accelerations. With --cutoff, the cut-off of their q is `LIGHTER` times that of torques, since the
output error does not amplify noise.

The length of the windows is chosen by inner splits: fits to some trajectories (or blocks) of the training data predict
the others. The parameters fitted to torques are a candidate too, and are kept if no window predicts longer.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.encoders.smoothing import Smoothed, smooth
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import in_blocks, select
from dln_jax.identification import equations
from dln_jax.identification.identify import Identification, identify, parameters_of
from dln_jax.identification.motions import REWEIGHTINGS, MotionFit, cut_motions, fit_motions
from dln_jax.learning.measured_motions import MeasuredWindows
from dln_jax.metrics.motions import cut_segments, predict_measured, valid_times
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError

WINDOWS = (0.3, 1.0)
"""Lengths of windows that inner splits choose from, s."""
FOLDS = 3
"""Inner splits, each with a third of the trajectories held out."""
PUSH = 0.1
"""Standard deviation of a window's constant torque error over that of a sample's, which partly averages out."""
LIGHTER, NYQUIST, STEP = 5.0, 0.4, 0.01
"""Cut-off of q for motions over that for torques, its largest share of the sampling rate, and their time step, s."""
HORIZON, EVERY = 2.2, 0.5
"""Length of a predicted segment and interval of starts, s; shorter if a held-out motion is shorter."""
TOGETHER = 32
"""Number of segments predicted at a time."""
FITTED = 0.1
"""Length of the first part of a segment, s, for fitting its initial state."""


class MotionSets(NamedTuple):
    """Motions to fit, and held-out ones to predict."""

    train: Trajectories
    test: Trajectories


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


class Chosen(NamedTuple):
    """A choice between torques and motions by inner splits."""

    window: float | None
    """Length of the windows, s; `None` keeps the parameters fitted to torques."""
    seconds: dict[str, float]
    """Mean valid prediction time on inner held-out motions, by "torques" and length; empty without inner splits."""
    left_out: str = ""
    """Why lengths were left out."""

    @property
    def line(self) -> str:
        """The choice and its reason, as text."""
        shown = ", ".join(f"{name} {value:.3g} s" for name, value in self.seconds.items())
        kept = "parameters by torques" if self.window is None else f"windows of {self.window:g} s"
        others = f"; other lengths were left out: {self.left_out}" if self.left_out else ""
        return f"chosen by inner splits of the training data: {kept} (prediction times: {shown}){others}"


def fit_by(
    by: str, model: Model, known: Parameters, solution: Identification, train: Trajectories, sets: MotionSets,
    window: float | None, **options: Any,
) -> tuple[Identification, MotionFit | None, Chosen]:  # fmt: skip
    """Refits the solution to motions, or to motions and torques; also returns the record of that fit and the choice.

    Args:
        by: "motions" or "both".
        known: parameters of the rigid tree in the robot's file.
        solution: consistent fit of the torques.
        sets: motions; those of `sets.train` have the trajectories of `train`.
        window: length of the windows, s (default: chosen from `WINDOWS` by inner splits).
        options: options of `identify`, for the fits of torques in inner splits.

    Raises:
        InputError: physically inconsistent parameters, or a window of fewer than four samples.
    """
    if solution.consistent is None:
        raise InputError(f"--by {by} needs physically consistent bodies to simulate; leave --no-consistent out")
    choice = chosen_window(by, model, known, train, sets.train, **options) if window is None else Chosen(window, {})
    if choice.window is None:
        return solution, None, choice
    fit = fitted(by, model, solution, train, sets.train, choice.window, known=known)
    kept = solution.consistent._replace(theta=fit.theta, converged=fit.converged)
    return solution._replace(consistent=kept), fit, choice


def fitted(
    by: str, model: Model, solution: Identification, train: Trajectories, motions: Trajectories, window: float,
    *, known: Parameters, reweightings: int = REWEIGHTINGS,
) -> MotionFit:  # fmt: skip
    """The fit to windows of this length; arguments and errors as for `fit_by`."""
    length = round(window / step_of(motions)) + 1
    if length < 4:
        raise InputError(f"--window {window} has {length} samples of the log; expected 4 at least")
    torques = None
    if by == "both":
        # Samples with correlated residuals count once, as in the standard errors.
        noise = solution.fit.noise * np.sqrt(solution.statistics.correlation)
        compact = equations.compressed(equations.regressor_of(model, parameters_of(solution.theta, known), train))
        torques = equations.weighted(compact, noise)
    return fit_motions(
        model, solution.columns, solution.known, solution.theta, cut_motions(motions, length),
        noise_tau=PUSH * solution.fit.noise, torques=torques, reweightings=reweightings,
    )  # fmt: skip


def chosen_window(
    by: str, model: Model, known: Parameters, train: Trajectories, motions: Trajectories, **options: Any
) -> Chosen:
    """Chooses by the mean valid prediction time of inner held-out trajectories, or of blocks of a single trajectory.

    A length is left out if its motions are not finite. If all predict equally long, the first length is taken.
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
        thetas: dict[float | None, np.ndarray] = {None: solution.theta}
        for window in [window for window in WINDOWS if window in times]:
            try:
                thetas[window] = fitted(by, model, solution, inner, moved, window, known=known, reweightings=0).theta
            except InputError as error:
                del times[window]
                reason = str(error)
        for window, theta in thetas.items():
            times[window].append(prediction_times(model, parameters_of(theta, known), held, variance)[0])
    means = {window: float(np.mean(np.concatenate(parts))) for window, parts in times.items()}
    best = max(means, key=lambda window: means[window])
    return Chosen(
        best, {"torques" if window is None else f"{window:g} s": mean for window, mean in means.items()}, reason
    )


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
    padded = MeasuredWindows(*(array[rows] for array in segments))
    predicted = predict_measured(model, parameters, padded, fitted=fitted)
    return valid_times(padded, predicted, fitted=fitted, variance=variance)[:count], (samples - fitted) * step


def prediction_metrics(
    model: Model, known: Parameters, sets: MotionSets, by_torques: np.ndarray, kept: np.ndarray, fit: MotionFit | None
) -> dict[str, float | int]:
    """Entries of metrics.json: prediction times of both fits, the delay, and the distance of the fitted motions."""
    variance = spread_of(*sets)
    before, length = prediction_times(model, parameters_of(by_torques, known), sets.test, variance)
    after, _ = prediction_times(model, parameters_of(kept, known), sets.test, variance)
    of_fit = {} if fit is None else {
        "delay_seconds": fit.delay, "motion_rms_before": fit.before, "motion_rms": fit.after, "rounds": fit.rounds,
    }  # fmt: skip
    return {
        "vpt_seconds": float(np.mean(after)), "by_torques_vpt_seconds": float(np.mean(before)),
        "predicted_seconds": length, **of_fit,
    }  # fmt: skip


def motion_lines(by: str, fit: MotionFit | None, choice: Chosen, numbers: dict[str, float | int]) -> list[str]:
    """Summary of the fit to motions, in a few lines."""
    lines = [choice.line] if choice.seconds else []
    if fit is not None:
        lines.append(
            f"by {by}: windows are off by {fit.after:.3g} of their noise (before: {fit.before:.3g}; {fit.rounds} "
            "rounds)"
        )
    lines.append(
        f"held-out motions: predicted for {numbers['vpt_seconds']:.3g} s of {numbers['predicted_seconds']:.3g} s, by "
        f"torques alone for {numbers['by_torques_vpt_seconds']:.3g} s (mean valid prediction time)"
    )
    if fit is not None:
        lines.append(f"motions follow the logged torques by {1e3 * fit.delay:.1f} ms; the model has no delay")
    if fit is not None and not fit.converged:
        lines.append("the fit to motions did not converge; record motions closer to the use")
    return lines
