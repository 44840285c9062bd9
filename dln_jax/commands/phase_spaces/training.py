"""Fits a model to rates and then to motions, in coordinates and momenta or in velocities.

Spring and pendulum have noise on the states and none on the rates: models are fitted to rates first and then to
trajectories with free starts, which removes the bias due to the noise. The other generated tasks have no noise and are
fitted to rates alone. Measured rates, usually noisy or estimated, serve for a first fit before that to trajectories.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.commands.phase_spaces.data import ANCHOR, PhaseLog, spreads
from dln_jax.data.schema import Trajectories, column
from dln_jax.data.splits import PER_SAMPLE, hold_out
from dln_jax.learning.engine.checkpoint import Context
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton, Optimiser
from dln_jax.learning.engine.problem import Problem, Progress, Training, losses, one_after_the_other
from dln_jax.learning.matching import accelerations_problem, match_linear, rates_problem
from dln_jax.learning.shooting import (
    Gauge,
    MeasuredWindows,
    Weights,
    cut_measured_windows,
    measured_problem,
    phase_problem,
)
from dln_jax.models.model import Model, Parameters
from dln_jax.scale import of_first_process
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import Description, build
from dln_jax.zoo.run import save

POLYNOMIAL = "polynomial-hamiltonian"
"""Model whose fit of rates is one least-squares problem."""
LINEAR = ("trigonometric", "planar-chain")
"""Models of measured motions whose parameters enter linearly."""
IN_VELOCITIES = ("structured-hnn", "structured-delan", *LINEAR)
"""Models of measured motions that are fitted in coordinates and velocities and define their own momenta."""
RATES, MOTIONS = "rates", "motions"
VALIDATION_SHARE = 0.15
"""Fraction of the training trajectories used for validation."""
EXACT = 1e-8
"""With a smaller error, relative to the mean square of measured rates, no other model or fit of motions is needed."""
WINDOWS_OF_A_STEP = 64
"""Batch size of Adam, in windows, for the fit of motions."""
MOTIONS_COMPILE = 6.0
"""Approximate ratio of the compile times of motions and rates (5 to 7): a compilation cannot be interrupted."""
FLAT = 1e-5
"""The fit of motions ends when the relative decrease of the loss per Gauss-Newton iteration is smaller."""
MOST_SUBSTEPS = 8
INTEGRATION_SHARE = 0.1
"""Largest integration error over a window, relative to the noise."""

Halves = tuple[Trajectories, Trajectories]
"""Training and validation trajectories."""


class PhaseFit(NamedTuple):
    """A trained model."""

    description: Description
    model: Model
    parameters: Parameters
    velocities: bool
    """Whether the model was fitted in coordinates and velocities."""
    training: Training
    """The last fit."""
    history: list[Progress]
    """Progress of all fits, with a continuous count of steps and seconds."""
    compile_seconds: float
    stop: str
    """Why the training ended: "time", "not finite", or another reason that is not a failure."""
    remark: str
    """Explains why a fit was skipped or ended early; empty otherwise."""


def in_velocities(log: PhaseLog, description: Description) -> bool:
    """Whether a model is fitted in coordinates and velocities instead of momenta."""
    return log.noise is not None and description["name"] in IN_VELOCITIES


def gauge_of(log: PhaseLog) -> Gauge:
    """The gauge: unit inertia with revolute joints at zero and prismatic joints at their mean."""
    turning = np.array(log.needs.joints) == "revolute"
    return Gauge(tuple(np.where(turning, 0.0, log.fitted.q.mean(axis=0)).tolist()))


def mean_square_rates(log: PhaseLog, description: Description, data: Trajectories) -> float:
    """Mean square of the rates, the reference for errors of a fit of rates."""
    if in_velocities(log, description):
        return float(data.degrees_of_freedom)  # `accelerations` divides by the spread
    return float(np.mean(np.concatenate([data.qd, column(data, "pd")]) ** 2))


def problem_of_rates(log: PhaseLog, description: Description, parts: Halves, seed: int) -> Problem:
    """The fit of rates: accelerations, or (qd, pd)."""
    model, most = build(description), log.task.samples
    if in_velocities(log, description):
        initial = jax.jit(model.init)(jax.random.key(seed))
        return accelerations_problem(model, initial, *parts, gauge=gauge_of(log), most_samples=most, seed=seed)
    return rates_problem(model, *parts, seed=seed, most_samples=most)


def problem_of_motions(log: PhaseLog, description: Description, parts: Halves, start: Any, seed: int) -> Problem:
    """The fit of motions, starting from parameters of the first fit."""
    task, model, weights, substeps = log.task, build(description), log.weights, log.task.substeps
    windows = [cut_measured_windows(part, task.window) for part in parts]
    if log.noise is not None and in_velocities(log, description):
        known = {"noise": log.noise, "gauge": gauge_of(log), "substeps": substeps, "seed": seed}
        return measured_problem(model, start, *windows, **known)
    if weights is None:
        weights = task.weights or deviations(parts[0])
    else:
        substeps = substeps_of(windows[0], weights)
    return phase_problem(model, start, *windows, weights=weights, substeps=substeps, seed=seed)


def substeps_of(windows: MeasuredWindows, weights: Weights) -> int:
    """RK4 steps between samples that keep the error over a window well below the noise, at most `MOST_SUBSTEPS`.

    For an oscillation of angular frequency w, a step h has an error of (w h)⁵ / 120 times the amplitude.
    """
    states = np.concatenate([windows.q, np.asarray(windows.p)], axis=2)
    size = states.reshape(-1, states.shape[2]).std(axis=0)
    change = np.diff(states, axis=1)[windows.weight[:, 1:] > 0]
    angle = np.max(np.sqrt(np.mean(change**2, axis=0)) / np.where(size > 0, size, np.inf))
    allowed = INTEGRATION_SHARE * np.min(np.asarray(weights.state) / np.where(size > 0, size, 1.0), initial=1.0)
    steps = np.arange(1, MOST_SUBSTEPS + 1)
    enough = windows.t.shape[1] * steps * (angle / steps) ** 5 / 120 <= allowed
    return int(steps[np.argmax(enough)]) if enough.any() else MOST_SUBSTEPS


def deviations(data: Trajectories) -> Weights:
    """Weights by the spread of the data; velocities from finite differences of q only anchor the scale of p."""
    size = spreads(data, "q", "p")
    if "qd" in data.estimated and np.array_equal(column(data, "p"), data.qd):
        size[data.degrees_of_freedom :] *= ANCHOR
    return Weights(state=tuple(size.tolist()))


def train(
    log: PhaseLog,
    description: Description,
    context: Context = Context(),  # noqa: B008
    *,
    optimiser: Optimiser = GaussNewton(),  # noqa: B008
    steps: int | None = None,
) -> PhaseFit:
    """Fits a model to rates and then, if the task says so, to trajectories, by `steps` or the task's steps.

    The context limits both fits together, compilation included. The fit of rates is the result if the time left is too
    short to compile the next program, or if the fit of motions is not finite at its start. It is stored in the
    context's folder before motions are fitted. Motions are not fitted if measured rates are exact.

    Raises:
        InputError: numbers in the data that are too large for a loss.
    """
    task, seed, velocities = log.task, context.seed, in_velocities(log, description)
    numbers = [getattr(log.fitted, key) for key in PER_SAMPLE]
    parts = hold_out(log.fitted, VALIDATION_SHARE, seed)

    def fit_stage(stage: str, problem: Problem, most: int, must_start: bool) -> Training:
        own = optimiser._replace(steps=steps or most)
        if isinstance(own, Adam):
            own = own._replace(patience=own.steps, batch=WINDOWS_OF_A_STEP if stage == MOTIONS else own.batch)
        elif stage == MOTIONS:
            # One iteration per dispatch, so that the time limit is kept and validation judges every iteration.
            own = own._replace(improvement=FLAT, steps_per_dispatch=1)
        known = {"model": description, "seed": seed, "samples": task.samples}
        with context.progress(own.steps) as show:
            return fit(
                problem,
                own,
                checkpoint=context.checkpoint(f"checkpoint_{stage}", own, numbers, **known),
                report=lambda at: show(at.step, f"{stage}: {losses(at)}"),
                seconds=context.seconds,
                must_start=must_start,
                mesh=context.mesh,
            )

    if description["name"] == POLYNOMIAL:
        first = match_linear(build(description), parts[0], validation=parts[1])[0]
    else:
        first = fit_stage(RATES, problem_of_rates(log, description, parts, seed), task.steps, True)
    done, stage, last = {RATES: first}, RATES, first
    stop, remark = first.stop.reason, ""
    if task.trajectory_steps and stop != "not finite":
        left = of_first_process(context.seconds, context.mesh)
        measured = {"qd", "qdd" if velocities else "pd"}.isdisjoint(log.fitted.estimated) and log.weights is not None
        negligible = EXACT * mean_square_rates(log, description, parts[1])
        if measured and (log.free_of_noise or first.validation <= negligible):
            stop, remark = (
                "exact",
                "the measured rates are free of noise or fitted exactly, so no fit to motions is needed",
            )
        elif stop == "time" or left <= MOTIONS_COMPILE * (first.compile_seconds or first.train_seconds):
            stop, remark = "time", "time was up after the fit to rates; motions were not fitted"
        else:
            if context.folder is not None:
                save(context.folder, description, first.parameters)
                context.say(f"{context.folder} holds the model fitted to rates; the fit to motions begins")
            problem = problem_of_motions(log, description, parts, first.parameters, seed)
            stage, last = MOTIONS, fit_stage(MOTIONS, problem, task.trajectory_steps, False)
            stop = last.stop.reason
            if not velocities:
                last = last._replace(parameters=last.parameters["model"])
            if last.stop.step and np.isfinite(last.validation):
                done[MOTIONS] = last
    at = f"after step {last.stop.step} of the fit to {stage}"
    if stop == "time" and not remark:
        remark = f"time was up {at}; the best parameters so far are kept"
    if stop == "not finite":
        adam = isinstance(optimiser, Adam)
        remedy = "lower --learning-rate" if adam else "state the plant's --needs, try another --model"
        remark = (
            f"the loss stopped being finite {at}; the last good model is kept; {remedy}, or check the data for huge "
            "numbers"
        )
    training = done.get(MOTIONS, first)
    if not np.isfinite(training.validation):
        raise InputError(remark or "no validation error is finite; look for very large numbers in the data")
    history = one_after_the_other([at._replace(stage=name) for at in one.history] for name, one in done.items())
    compiled = sum(one.compile_seconds for one in done.values())
    model, parameters = build(description), training.parameters
    return PhaseFit(description, model, parameters, velocities, training, history, compiled, stop, remark)
