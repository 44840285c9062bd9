"""Evaluates a Hamiltonian model on the motions of its task: errors, times, verdict, table and figures."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import numpy as np
import optax

from dln_jax.commands.phase_spaces.data import PhaseLog, spreads
from dln_jax.commands.phase_spaces.training import MOTIONS, RATES, PhaseFit
from dln_jax.data.schema import column
from dln_jax.figures.phase_space import Field, motion_figure, write_motion_gif
from dln_jax.figures.style import TRUTH
from dln_jax.figures.training import training_curve
from dln_jax.metrics.latency import one_step
from dln_jax.metrics.phase_space import Motions, energies, field_errors, field_rates, motion_errors, predict
from dln_jax.metrics.predictions import on_grid, padded, predict_measured, prediction_metrics
from dln_jax.metrics.verdict import judge_motions, quarter_period
from dln_jax.runs.report import Report, one_step_metrics, png, rows_of
from dln_jax.zoo.run import Run

SUBSTEPS = 4
"""RK4 substeps between two samples of a measured motion."""
GIF_FRAMES = 80
LOSSES = {
    RATES: "rates: mean square error of (qd, pd)",
    MOTIONS: "motions: mean square error of (q, p) over its weight",
}
"""Label of the loss of every stage."""
LABELS = {
    "energy_mse": "energy MSE of predicted motions",
    "rollout_mse": "(q, p) MSE of predicted motions",
    "vpt_seconds": "valid prediction time, mean",
    "vpt_median_seconds": "valid prediction time, median",
    "vpt_lyapunov": "valid prediction time, in Lyapunov times of the model",
    "predicted_seconds": "length of the predicted motions",
    "lyapunov_seconds": "Lyapunov time of the model",
    "energy_drift": "energy error of predicted motions over the largest kinetic energy",
    "train_loss": "(qd, pd) MSE at training states",
    "test_loss": "(qd, pd) MSE at test states",
    "clean_field_mse": "(qd, pd) MSE against the exact field",
    "validation_error": "validation loss of the last stage",
    "_standard_error": ", standard error over starts",
    "_median": ", median over starts",
}
"""Words for parts of metrics' names. The true plant has an energy error of 0."""
UNITS_OF_METRICS = {
    "published_energy_mse": "units of that energy²",
    "energy_mse": "J²",
    "rollout_mse": "units of q² and p²",
    "_loss": "units of qd² and pd²",
    "clean_field_mse": "units of qd² and pd²",
    "validation_error": "as in training.png",
}
UNITS = {"revolute": ("rad", "kg m²/s"), "prismatic": ("m", "kg m/s")}
"""Units of q and p."""


def evaluate(log: PhaseLog, fit: PhaseFit) -> Report:
    """Evaluates a fit on the test of its task."""
    truth, predicted = log.truth[0], predicted_motions(log, fit)
    run = Run(fit.model, fit.parameters, fit.description)
    rates = partial(accelerations, run) if fit.velocities else partial(field_rates, fit.model, fit.parameters)
    data, test, d = log.fitted, log.held_out, log.needs.degrees_of_freedom
    # The noise of estimated rates is unknown, and velocities are states of models in velocities: these do not count.
    known = np.repeat(["qd" not in test.estimated and not fit.velocities, "pd" not in test.estimated], d)
    unexplained = np.zeros(1)
    if known.any():
        sides = rates(test.q, column(test, "p")), (test.qd, column(test, "pd"))
        model, true = (np.hstack(side)[:, known] for side in sides)
        unexplained = np.mean((model - true) ** 2, axis=0) / np.var(true, axis=0)
    verdict = judge_motions(
        predicted,
        log.truth,
        size=spreads(data, "q", "p"),
        bounded=np.array([joint != "revolute" for joint in log.needs.joints] + [True] * d),
        noise=log.state_noise,
        measured=np.repeat([True, "p" not in data.estimated], d),
        fitted=samples_fitted(log, fit),
        rates=unexplained,
    )
    latency = one_step(run.flow.rates, list(zip(truth.q[0, :256], truth.p[0, :256], strict=True)), calls=2000)
    metrics = errors(log, fit, predicted) | one_step_metrics(latency)
    if log.noise is not None:
        metrics |= {f"q{joint}_noise": float(sd) for joint, sd in enumerate(np.ravel(log.noise.q), start=1)}
    metrics["validation_error"] = float(fit.training.validation)
    metrics = {key: value for key, value in metrics.items() if np.isfinite(value)}
    failed = fit.stop == "not finite"
    return Report(
        metrics=metrics | {"verdict": verdict.number},
        rows=rows_of(metrics, LABELS, UNITS_OF_METRICS),
        title=f"test motions of {log.name}, f64",
        verdict=verdict,
        figures=figures_of(log, fit, predicted[0], rates),
        chosen=fit.description,
        lines=(fit.remark,) if fit.remark and not failed else (),
        error=fit.remark if failed else "",
    )


def figures_of(log: PhaseLog, fit: PhaseFit, predicted: Motions, rates: Field) -> dict[str, Callable[[Path], None]]:
    """The applicable figures and films of the first motion, with its energy or, if unknown, the first coordinate."""
    name, H, truth = fit.description["name"], log.energy, log.truth[0]
    of_q, of_p = UNITS[log.needs.joints[0]]
    motions = {TRUTH: truth, name: predicted}
    heights = {key: moved.q[:, :, 0] if H is None else energies(H, moved) for key, moved in motions.items()}
    quantity, units = ("q1", (of_q, f"{of_q}/s", of_q)) if H is None else ("true energy", (of_q, of_p, "J"))
    stride = max(1, len(truth.t) // GIF_FRAMES)
    figures = {
        "motions.png": png(motion_figure, motions, heights, fields={name: rates}, quantity=quantity, units=units),
        "motions.gif": lambda path: write_motion_gif(path, motions, stride=stride, units=units[:2]),
    }
    if len(fit.history) > 1:
        best = fit.history[-1].step - fit.training.history[-1].step + fit.training.best_step
        named = [at._replace(stage=LOSSES[at.stage]) for at in fit.history]
        words = {"error": "loss", "loss": "training loss", "unit": "loss, of each stage in its own units"}
        figures["training.png"] = png(training_curve, named, best_step=best, **words)
    return figures


def errors(log: PhaseLog, fit: PhaseFit, predicted: list[Motions]) -> dict[str, float]:
    """Errors of the predicted motions and of the field, prediction times, and costs."""
    model, parameters = fit.model, fit.parameters
    numbers = motion_errors(predicted, log.truth, log.energy, published_energy=log.published_energy)
    if log.tests is not None:
        fitted = log.task.window
        known = {"fitted": fitted, "substeps": SUBSTEPS, "momenta": not fit.velocities}
        moved, variance = predict_measured(model, parameters, log.tests, **known), log.fitted.q.var(axis=0)
        numbers |= prediction_metrics(log.tests, moved, fitted=fitted, variance=np.where(variance > 0, variance, 1.0))
    if log.exact is not None:
        trained, tested = (field_errors(model, parameters, part) for part in log.exact)
        numbers["train_loss"], numbers["test_loss"] = trained["loss"], tested["loss"]
        numbers["clean_field_mse"] = tested["clean_field_mse"]
    return numbers | {
        "train_seconds": fit.history[-1].seconds if fit.history else 0.0,
        "compile_seconds": fit.compile_seconds,
        "parameters": float(optax.tree.size(parameters)),
    }


def predicted_motions(log: PhaseLog, fit: PhaseFit) -> list[Motions]:
    """Predicts the task's motions from their first states; p is the velocity for models with their own momenta."""
    model, parameters = fit.model, fit.parameters
    if fit.velocities:
        windows = padded([on_grid(true.t, true.q[0], true.p[0]) for true in log.truth])
        moved = predict_measured(model, parameters, windows, fitted=samples_fitted(log, fit), substeps=SUBSTEPS)
        pairs = zip(log.truth, moved.q, moved.qd, windows.weight > 0, strict=True)
        return [Motions(true.t, q[None, rows], qd[None, rows]) for true, q, qd, rows in pairs]
    # All times are padded to one length, so that one program predicts all motions.
    longest = max(len(true.t) for true in log.truth)
    predictions = []
    for true in log.truth:
        count = len(true.t)
        t = np.pad(true.t, (0, longest - count), mode="edge")
        moved = predict(model, parameters, true.q[:, 0], true.p[:, 0], t)
        predictions.append(Motions(moved.t[:count], moved.q[:, :count], moved.p[:, :count]))
    return predictions


def samples_fitted(log: PhaseLog, fit: PhaseFit) -> int:
    """Number of samples that the start of a predicted motion is fitted to; 1 if it is the first state.

    It is a window or, where samples are dense, an eighth of the period, but at most half of the shortest motion.
    """
    if not fit.velocities:
        return 1
    angles = np.array([joint == "revolute" for joint in log.needs.joints])
    dense = min(quarter_period(true.q, ~angles) for true in log.truth) // 2
    return max(2, min(max(log.task.window, dense), *(len(true.t) // 2 for true in log.truth)))


def accelerations(run: Run, q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(qd, qdd) of states, without torques."""
    return np.asarray(qd), np.asarray(jax.vmap(run.dynamics.forward_dynamics)(q, qd, 0 * q))
