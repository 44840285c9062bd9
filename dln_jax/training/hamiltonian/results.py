"""Metrics and figures of a Hamiltonian training, with labels for metrics.json."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.data.arrays import spread
from dln_jax.data.schema import column
from dln_jax.figures import animations
from dln_jax.figures.phase_space import Field
from dln_jax.figures.style import TRUTH
from dln_jax.figures.training import training_curve
from dln_jax.learning.latency import one_step
from dln_jax.metrics.verdict import Verdict, judge_motions
from dln_jax.runs.report import png
from dln_jax.training.hamiltonian.predictions import Seen, figure_of, measured_once, samples_fitted, units_of
from dln_jax.training.hamiltonian.stages import in_velocities
from dln_jax.training.hamiltonian.tasks import Problem
from dln_jax.training.hamiltonian.training import MOTIONS, RATES, Trained
from dln_jax.training.results import OF_LOSSES, one_step_metrics, unit_of
from dln_jax.zoo.run import load

GIF_FRAMES = 80
LOSSES = {
    RATES: "rates: mean square error of (qd, pd)",
    MOTIONS: "motions: mean square error of (q, p) over its weight",
}
"""Label of the loss of every stage."""


def evaluate(folder: Path, problem: Problem, trained: Trained) -> tuple[dict[str, float | int], Seen, Verdict]:
    """Entries of metrics.json, what figures show, and the verdict on the predicted test motions."""
    truth = problem.truth[0]
    metrics, seen, predicted = measured_once(problem, trained)
    rates = rates_unexplained(problem, trained, seen.rates)
    known = {**units_of_judgement(problem), "fitted": samples_fitted(problem, trained), "rates": rates}
    verdict = judge_motions(predicted, problem.truth, **known)
    states = list(zip(truth.q[0, :256], truth.p[0, :256], strict=True))
    metrics = {**metrics, **one_step_metrics(one_step(load(folder).flow.rates, states, calls=2000))}
    if problem.noise is not None:
        metrics |= {f"q{joint}_noise": float(sd) for joint, sd in enumerate(np.ravel(problem.noise.q), start=1)}
    metrics["validation_error"] = float(trained.result.validation)
    metrics = {key: value for key, value in metrics.items() if np.isfinite(value)}
    return metrics | {"verdict": verdict.number}, seen, verdict


def units_of_judgement(problem: Problem) -> dict[str, Any]:
    """Spread of q and p, which of them are bounded and were measured, and their noise if known."""
    data, d = problem.fitted, problem.needs.degrees_of_freedom
    size = np.concatenate([spread("q", data.q), spread("p", column(data, "p"))])
    angles = [joint == "revolute" for joint in problem.needs.joints]
    return {
        "size": np.where(size > 0, size, 1.0),
        "bounded": ~np.array(angles + [False] * d),
        "noise": None if problem.trust is None else problem.trust.noise,
        "measured": np.repeat([True, "p" not in data.estimated], d),
    }


def rates_unexplained(problem: Problem, trained: Trained, rates: Field) -> np.ndarray:
    """Shares of the variance of measured rates that the model leaves unexplained at test states.

    The noise of estimated rates is unknown, and velocities are states of models in velocities: these do not count.
    """
    data = problem.held_out
    if data is None:
        return np.zeros(1)
    informative = [key not in data.estimated for key in ("qd", "pd")]
    informative[0] &= not in_velocities(problem, trained.description)
    known = np.repeat(informative, problem.needs.degrees_of_freedom)
    sides = rates(data.q, column(data, "p")), (data.qd, column(data, "pd"))
    model, true = (np.concatenate(side, axis=1)[:, known] for side in sides)
    return np.mean((model - true) ** 2, axis=0) / np.var(true, axis=0) if known.any() else np.zeros(1)


def figures_of(problem: Problem, name: str, seen: Seen, trained: Trained) -> dict[str, Callable[[Path], None]]:
    """The applicable figures and films, by file name."""
    truth = problem.truth[0]
    film: dict[str, Any] = {"stride": max(1, len(truth.t) // GIF_FRAMES), "units": units_of(problem)[:2]}
    figures = {
        "motions.png": png(figure_of, problem, {name: seen}),
        "motions.gif": lambda path: animations.write_motion_gif(path, {TRUTH: truth, name: seen.motions}, **film),
    }
    history = trained.history
    if len(history) > 1:
        best = history[-1].step - trained.result.history[-1].step + trained.result.best_step
        named = [at._replace(stage=LOSSES[at.stage]) for at in history]
        options: dict[str, Any] = {"best_step": best, "unit": "loss, of each stage in its own units", **OF_LOSSES}
        figures["training.png"] = png(training_curve, named, **options)
    return figures


MEANINGS = {
    "published_energy_mse": ("published energy along predicted motions, mean square error", "units of that energy²"),
    "energy_mse": ("energy along predicted motions, mean square error", "J²"),
    "rollout_mse": ("(q, p) of predicted motions, mean square error", "units of q² and p²"),
    "train_loss": ("(qd, pd) at training states, mean square error", "units of qd² and pd²"),
    "test_loss": ("(qd, pd) at test states, mean square error", "units of qd² and pd²"),
    "clean_field_mse": ("(qd, pd) against the exact field, mean square error", "units of qd² and pd²"),
    "vpt": ("time of correct prediction of motions", "s"),
    "lyapunov_seconds": ("Lyapunov time of the model", "s"),
    "predicted_seconds": ("duration of the predicted motions", "s"),
    "energy_drift": ("energy error along predicted motions, over the largest kinetic energy", "1"),
    "validation_error": ("validation loss of the last stage", "see training.png"),
}
"""Labels and units by the prefix of a metric's name; the true plant has an energy error of 0."""
ENDINGS = {
    **{"_standard_error": ": its standard error over starts", "_median": ": its median over starts"},
    **{"_seconds": "", "_median_seconds": ": its median", "_lyapunov": ", in Lyapunov times of the model"},
}
"""Labels of the suffixes of such names."""


def line(metric: str, value: float) -> tuple[str, str, str]:
    """A metric as label, value and unit."""
    quantity = next((key for key in MEANINGS if metric.startswith(key)), "")
    meaning, unit = MEANINGS.get(quantity, (metric, unit_of(metric, {})))
    rest = metric.removeprefix(quantity or metric)
    unit = "1" if rest == "_lyapunov" else unit
    return meaning.replace("_", " ") + ENDINGS.get(rest, rest), f"{value:.4g}", unit
