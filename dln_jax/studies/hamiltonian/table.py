"""The table of Hamiltonian tasks: every model of the published ones, medians over seeds, beside published errors."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures.phase_space import Field, motion_figure
from dln_jax.figures.style import TRUTH
from dln_jax.files import write_figure
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.measured_predictions import on_grid, padded, predict_measured, prediction_metrics
from dln_jax.metrics.phase_space import Motions, energies, field_errors, field_rates, motion_errors, predict
from dln_jax.models.model import Model, Parameters
from dln_jax.studies.case import Case, Findings, by_case, rows_of
from dln_jax.studies.hamiltonian import pixels
from dln_jax.studies.hamiltonian.choice import description_of, models_of
from dln_jax.studies.hamiltonian.recipes import RECIPES
from dln_jax.studies.hamiltonian.stages import in_velocities
from dln_jax.studies.hamiltonian.tasks import MEASURED, PIXELS, REAL, WINDOW, Problem, problem_of
from dln_jax.studies.hamiltonian.training import Trained, train
from dln_jax.studies.published import HAMILTONIAN, published
from dln_jax.studies.report import Row, markdown_table, unit_of
from dln_jax.types import require_positive
from dln_jax.zoo.descriptions import build

TASKS = ("spring", "pendulum", REAL, "two-body", "three-body", PIXELS)
"""The published ones."""
BOUNDS = {
    "spring/separable-hnn": {"energy_mse": 3.8e-5, "train_seconds": 5.0},
    "pendulum/separable-hnn": {"published_energy_mse": 2.5e-3, "train_seconds": 8.0},
    "real-pendulum/separable-hnn": {"energy_mse": 8e-4, "train_seconds": 60.0},
    "two-body/pairwise-hnn": {"energy_mse": 3.9e-6, "train_seconds": 30.0},
    "three-body/pairwise-hnn": {"energy_mse": 4.2e-3, "energy_mse_median": 4.2e-3, "train_seconds": 300.0},
    "pixels/black-box-hnn": {"energy_mse": 1.5e-4, "energy_mse_over_baseline": 0.1, "train_seconds": 300.0},
}
"""Figures to reach, of the model that suits the scene."""
SHOWN = (
    *("test_loss", "clean_field_mse", "energy_mse", "energy_mse_standard_error", "energy_mse_median"),
    *("energy_mse_over_baseline", "published_energy_mse", "rollout_mse", "train_seconds", "compile_seconds"),
)
TITLES = {
    "test_loss": "test loss",
    "clean_field_mse": "clean field",
    "energy_mse": "energy MSE",
    "published_energy_mse": "energy MSE, q²+p²",
    "rollout_mse": "rollout MSE",
    "train_seconds": "training, s",
}


SUBSTEPS = 4
"""Of RK4 between two samples of a measured motion."""


class Seen(NamedTuple):
    """What a figure shows of a model."""

    motions: Motions
    """The first entry of the problem's, as predicted."""
    rates: Field


def measured_once(problem: Problem, trained: Trained) -> tuple[dict[str, float], Seen, list[Motions]]:
    """Errors and times of one run, what a figure shows of it, and the motions that it predicts."""
    model, parameters = build(trained.description), trained.result.parameters
    predicted, rates = predicted_motions(problem, trained), partial(field_rates, model, parameters)
    if in_velocities(problem, trained.description):
        rates = partial(velocity_field, model, parameters)
    numbers = motion_errors(predicted, problem.truth, problem.energy, published_energy=problem.published_energy)
    if problem.tests is not None:
        numbers |= predicted_times(problem, trained)
    if problem.train is not None and problem.test is not None:
        fitted, tested = (field_errors(model, parameters, part) for part in (problem.train, problem.test))
        numbers["train_loss"], numbers["test_loss"] = fitted["loss"], tested["loss"]
        numbers["clean_field_mse"] = tested["clean_field_mse"]
    for name in ("train_seconds", "compile_seconds"):
        numbers[name] = sum(getattr(fit, name) for fit in trained.fits.values())
    numbers["parameters"] = float(sum(leaf.size for leaf in jax.tree.leaves(parameters)))
    return numbers, Seen(predicted[0], rates), predicted


def predicted_motions(problem: Problem, trained: Trained) -> list[Motions]:
    """The problem's motions from their first states, whose momenta are velocities where a model has its own."""
    model, parameters = build(trained.description), trained.result.parameters
    if in_velocities(problem, trained.description):
        given = padded([on_grid(true.t, true.q[0], true.p[0]) for true in problem.truth])
        fitted = min(WINDOW[MEASURED], *(len(true.t) - 1 for true in problem.truth))
        moved = predict_measured(model, parameters, given, fitted=fitted, substeps=SUBSTEPS)
        kept = [np.flatnonzero(weight) for weight in given.weight]
        pairs = zip(problem.truth, moved.q, moved.qd, kept, strict=True)
        return [Motions(true.t, q[None, rows], qd[None, rows]) for true, q, qd, rows in pairs]
    # Times of one length, so that one program predicts all.
    longest = max(len(true.t) for true in problem.truth)
    times = [np.pad(true.t, (0, longest - len(true.t)), mode="edge") for true in problem.truth]
    return [
        first_samples(predict(model, parameters, true.q[:, 0], true.p[:, 0], t), len(true.t))
        for true, t in zip(problem.truth, times, strict=True)
    ]


def first_samples(motions: Motions, count: int) -> Motions:
    """The first samples of each motion."""
    return Motions(motions.t[:count], motions.q[:, :count], motions.p[:, :count])


def predicted_times(problem: Problem, trained: Trained) -> dict[str, float]:
    """For how long measured motions are predicted right, whose starts are fitted to one window."""
    assert problem.tests is not None
    model, fitted = build(trained.description), WINDOW[MEASURED]
    known = {"fitted": fitted, "substeps": SUBSTEPS, "momenta": not in_velocities(problem, trained.description)}
    predicted = predict_measured(model, trained.result.parameters, problem.tests, **known)
    variance = problem.fitted.q.var(axis=0)
    return prediction_metrics(problem.tests, predicted, fitted=fitted, variance=np.where(variance > 0, variance, 1.0))


def velocity_field(
    model: Model, parameters: Parameters, q: np.ndarray, qd: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(qd, qdd) of states, without torques."""
    accelerate = dynamics(model.energies(parameters)).forward_dynamics
    qdd = jax.jit(jax.vmap(lambda q, qd: accelerate(q, qd, 0 * q)))(q, qd)
    return np.asarray(qd), np.asarray(qdd)


def figure_of(problem: Problem, seen: Mapping[str, Seen]) -> Figure:
    """The figure of a task: the first motion as each model has it, and its energy, or that of the first coordinate."""
    motions = {TRUTH: problem.truth[0], **{name: each.motions for name, each in seen.items()}}
    fields = {name: each.rates for name, each in seen.items()}
    H = problem.energy
    heights = {name: each.q[:, :, 0] if H is None else energies(H, each) for name, each in motions.items()}
    quantity = "q1" if H is None else "true energy"
    return motion_figure(motions, heights, fields=fields, quantity=quantity, units=units_of(problem))


def units_of(problem: Problem) -> tuple[str, str, str]:
    """Of the first coordinate, of its momentum, and of what the task's figure shows over time."""
    of_q, of_p = {"revolute": ("rad", "kg m²/s"), "prismatic": ("m", "kg m/s")}[problem.needs.joints[0]]
    return (of_q, of_p, "J") if problem.energy is not None else (of_q, f"{of_q}/s", of_q)


def cases(
    names: Sequence[str] = tuple(name for name in TASKS if name != REAL),
    *,
    seeds: int = 3,
    steps: int | None = None,
    trajectories: int | None = None,
    real_pendulum: Path | None = None,
    folder: Path | None = None,
) -> list[Case]:
    """A case for each task, with every model of it; `InputError` for a number that is not positive.

    By default `steps` of each fit are each task's own, `trajectories` the published number, and the measured task needs
    the file `real_pendulum`. With a `folder`, each task's figure is drawn while what it shows is at hand.
    """
    given = {"steps": steps, "trajectories": trajectories}
    require_positive(seeds=seeds, **{key: value for key, value in given.items() if value is not None})
    found = []
    for name in names:
        task = pixel_task if name == PIXELS else partial(phase_task, name, data=real_pendulum if name == REAL else None)
        kinds = pixels.MODELS if name == PIXELS else models_of(name)
        measure = partial(task, seeds=seeds, folder=folder, **given)
        found.append(Case(name, measure, {f"{name}/{kind}": () for kind in kinds}))
    return found


def phase_task(
    name: str, *, seeds: int, steps: int | None, trajectories: int | None, data: Path | None, folder: Path | None
) -> Findings:
    """Every model of a task in coordinates and momenta, and its figure."""
    problem = problem_of(name, trajectories=trajectories, data=data)
    options: dict[str, Any] = {"steps": steps, "seconds": RECIPES[name].seconds}
    rows: list[Row] = []
    seen: dict[str, Seen] = {}
    for kind in models_of(name):
        description = description_of(problem, kind)
        # Each seed pays for its own compilation, as a user does.
        runs = [measured_once(problem, train(problem, description, seed=seed, **options)) for seed in range(seeds)]
        rows += rows_of(f"{name}/{kind}", medians(runs))
        seen[kind] = runs[0][1]
    if folder is not None:
        write_figure(folder / f"{name}.png", figure_of(problem, seen))
    return Findings(rows)


def pixel_task(*, seeds: int, steps: int | None, trajectories: int | None, folder: Path | None) -> Findings:
    """The models of pictures, and their animation and pictures."""
    data = pixels.pixel_data(trajectories)
    numbers, seen = {}, {}
    for kind in pixels.MODELS:
        runs = [pixels.measure_pixels(kind, data, seed=seed, steps=steps) for seed in range(seeds)]
        numbers[kind], seen[kind] = medians(runs), runs[0][1]
    energetic, baseline = (numbers[kind] for kind in pixels.MODELS)
    energetic["energy_mse_over_baseline"] = energetic["energy_mse"] / baseline["energy_mse"]
    if folder is not None:
        pixels.draw_pixels(seen, data, folder)
    return Findings([row for kind, each in numbers.items() for row in rows_of(f"{PIXELS}/{kind}", each)])


def medians(runs: Sequence[tuple[dict[str, float], *tuple[Any, ...]]]) -> dict[str, float]:
    """Of each quantity over the seeds, and the largest energy error."""
    of_seeds = [numbers for numbers, *_ in runs]
    found = {key: float(np.median([each[key] for each in of_seeds])) for key in of_seeds[0]}
    found["energy_mse_largest"] = float(np.max([each["energy_mse"] for each in of_seeds]))
    return {key: value for key, value in found.items() if not np.isnan(value)}


def table_rows(rows: Sequence[Row]) -> list[Row]:
    """Numbers with the published ones and the figures to reach; every Hamiltonian network beside the published one."""
    return [
        row._replace(
            unit=unit_of(row.quantity),
            reference=beside(row.case, row.quantity),
            bound=BOUNDS.get(row.case, {}).get(row.quantity),
        )
        for row in rows
    ]


def beside(case: str, quantity: str) -> float | None:
    """The published number that a model stands beside: the baseline's, or the Hamiltonian network's."""
    task, kind = case.split("/")
    name = kind if kind == "phase-network" else "black-box-hnn"
    return published(HAMILTONIAN, f"{task}/{name}", quantity)


def markdown(rows: Sequence[Row]) -> str:
    """Ours / published, a line per case: of the model that suits the scene, and of the baseline."""
    lines, compared = [], {*BOUNDS, *(f"{task}/phase-network" for task in TASKS)}
    for case, numbers in by_case(rows).items():
        cells = [case]
        for quantity in TITLES:
            value, theirs = numbers.get(quantity), beside(case, quantity) if case in compared else None
            text = "" if value is None else f"{value:.1f}" if quantity == "train_seconds" else f"{value:.1e}"
            if f"{quantity}_standard_error" in numbers:
                text += f" ± {numbers[f'{quantity}_standard_error']:.0e}"
            if value is not None and theirs is not None:
                text += f" / {theirs:.1e}"
            cells.append(text)
        lines.append(cells)
    return markdown_table(["task / model", *TITLES.values()], lines)
