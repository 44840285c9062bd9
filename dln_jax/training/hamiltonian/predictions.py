"""Predictions of a trained Hamiltonian model for the motions of a problem: errors, times and the figure."""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures.phase_space import Field, motion_figure
from dln_jax.figures.style import TRUTH
from dln_jax.learning.shooting import MeasuredWindows
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.motions import on_grid, padded, predict_measured, prediction_metrics
from dln_jax.metrics.phase_space import (
    Motions,
    energies,
    field_errors,
    field_rates,
    motion_errors,
    predict,
    quarter_period,
)
from dln_jax.models.model import Model, Parameters
from dln_jax.training.hamiltonian.stages import in_velocities
from dln_jax.training.hamiltonian.tasks import MEASURED, WINDOW, Problem
from dln_jax.training.hamiltonian.training import Trained
from dln_jax.zoo.descriptions import build

SUBSTEPS = 4
"""RK4 substeps between two samples of a measured motion."""


class Seen(NamedTuple):
    """Content of a figure for one model."""

    motions: Motions
    """Prediction of the problem's first entry."""
    rates: Field


def measured_once(problem: Problem, trained: Trained) -> tuple[dict[str, float], Seen, list[Motions]]:
    """Errors and times of one run, what a figure shows of it, and the predicted motions."""
    model, parameters = build(trained.description), trained.result.parameters
    predicted, rates = predicted_motions(problem, trained), partial(field_rates, model, parameters)
    if in_velocities(problem, trained.description):
        rates = partial(velocity_field, model, parameters)
    numbers = motion_errors(predicted, problem.truth, problem.energy, published_energy=problem.published_energy)
    if problem.tests is not None:
        numbers |= predicted_times(problem, problem.tests, trained)
    if problem.train is not None and problem.test is not None:
        fitted, tested = (field_errors(model, parameters, part) for part in (problem.train, problem.test))
        numbers["train_loss"], numbers["test_loss"] = fitted["loss"], tested["loss"]
        numbers["clean_field_mse"] = tested["clean_field_mse"]
    for name in ("train_seconds", "compile_seconds"):
        numbers[name] = sum(getattr(fit, name) for fit in trained.fits.values())
    numbers["parameters"] = float(sum(leaf.size for leaf in jax.tree.leaves(parameters)))
    return numbers, Seen(predicted[0], rates), predicted


def predicted_motions(problem: Problem, trained: Trained) -> list[Motions]:
    """Predicts the problem's motions from their first states; p is the velocity for models with their own momenta."""
    model, parameters = build(trained.description), trained.result.parameters
    if in_velocities(problem, trained.description):
        windows = padded([on_grid(true.t, true.q[0], true.p[0]) for true in problem.truth])
        fitted = samples_fitted(problem, trained)
        moved = predict_measured(model, parameters, windows, fitted=fitted, substeps=SUBSTEPS)
        kept = [np.flatnonzero(weight) for weight in windows.weight]
        pairs = zip(problem.truth, moved.q, moved.qd, kept, strict=True)
        return [Motions(true.t, q[None, rows], qd[None, rows]) for true, q, qd, rows in pairs]
    # All times are padded to one length, so that one program predicts all motions.
    longest = max(len(true.t) for true in problem.truth)
    times = [np.pad(true.t, (0, longest - len(true.t)), mode="edge") for true in problem.truth]
    return [
        first_samples(predict(model, parameters, true.q[:, 0], true.p[:, 0], t), len(true.t))
        for true, t in zip(problem.truth, times, strict=True)
    ]


def samples_fitted(problem: Problem, trained: Trained) -> int:
    """Number of samples that the start of a predicted motion is fitted to; 1 if it is the first state.

    It is a window or, where samples are dense, an eighth of the period, but at most half of the shortest motion.
    """
    if not in_velocities(problem, trained.description):
        return 1
    angles = np.array([joint == "revolute" for joint in problem.needs.joints])
    dense = min(quarter_period(true.q, ~angles) for true in problem.truth) // 2
    return max(2, min(max(WINDOW[MEASURED], dense), *(len(true.t) // 2 for true in problem.truth)))


def first_samples(motions: Motions, count: int) -> Motions:
    """The first `count` samples of every motion."""
    return Motions(motions.t[:count], motions.q[:, :count], motions.p[:, :count])


def predicted_times(problem: Problem, tests: MeasuredWindows, trained: Trained) -> dict[str, float]:
    """Valid prediction times on measured motions, with starts fitted to one window."""
    model, fitted = build(trained.description), WINDOW[MEASURED]
    known = {"fitted": fitted, "substeps": SUBSTEPS, "momenta": not in_velocities(problem, trained.description)}
    predicted = predict_measured(model, trained.result.parameters, tests, **known)
    variance = problem.fitted.q.var(axis=0)
    return prediction_metrics(tests, predicted, fitted=fitted, variance=np.where(variance > 0, variance, 1.0))


def velocity_field(
    model: Model, parameters: Parameters, q: np.ndarray, qd: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(qd, qdd) of states, without torques."""
    accelerate = dynamics(model.energies(parameters)).forward_dynamics
    qdd = jax.jit(jax.vmap(lambda q, qd: accelerate(q, qd, 0 * q)))(q, qd)
    return np.asarray(qd), np.asarray(qdd)


def figure_of(problem: Problem, seen: Mapping[str, Seen]) -> Figure:
    """The figure of a task: the first motion by every model, and its energy or, if unknown, the first coordinate."""
    motions = {TRUTH: problem.truth[0], **{name: model.motions for name, model in seen.items()}}
    fields = {name: model.rates for name, model in seen.items()}
    H = problem.energy
    heights = {name: motion.q[:, :, 0] if H is None else energies(H, motion) for name, motion in motions.items()}
    quantity = "q1" if H is None else "true energy"
    return motion_figure(motions, heights, fields=fields, quantity=quantity, units=units_of(problem))


def units_of(problem: Problem) -> tuple[str, str, str]:
    """Units of the first coordinate, of its momentum, and of the quantity that the task's figure shows over time."""
    of_q, of_p = {"revolute": ("rad", "kg m²/s"), "prismatic": ("m", "kg m/s")}[problem.needs.joints[0]]
    return (of_q, of_p, "J") if problem.energy is not None else (of_q, f"{of_q}/s", of_q)
