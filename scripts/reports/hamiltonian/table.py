"""The table of Hamiltonian tasks: models of the published tasks, medians over seeds, and published errors."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.files import write_figure
from dln_jax.models.latent_phase import Field
from dln_jax.training.hamiltonian import pixels
from dln_jax.training.hamiltonian.model_selection import POLYNOMIAL, description_of
from dln_jax.training.hamiltonian.predictions import Seen, figure_of, measured_once
from dln_jax.training.hamiltonian.recipes import RECIPES
from dln_jax.training.hamiltonian.tasks import REAL, problem_of
from dln_jax.training.hamiltonian.training import train
from dln_jax.types import require_positive
from scripts.reports.case import Case, Findings, rows_of
from scripts.reports.published import HAMILTONIAN, published
from scripts.reports.rows import Row, unit_of

PIXELS = "pixels"
TASKS = ("spring", "pendulum", REAL, "two-body", "three-body", PIXELS)
"""The published tasks."""
MODELS: tuple[Field, ...] = ("black-box-hnn", "phase-network")
"""Models of every task, in addition to the one that suits the scene."""
BOUNDS = {
    "spring/separable-hnn": {"energy_mse": 3.8e-5, "train_seconds": 5.0},
    "pendulum/separable-hnn": {"published_energy_mse": 2.5e-3, "train_seconds": 8.0},
    "real-pendulum/separable-hnn": {"energy_mse": 8e-4, "train_seconds": 60.0},
    "two-body/pairwise-hnn": {"energy_mse": 3.9e-6, "train_seconds": 30.0},
    "three-body/pairwise-hnn": {"energy_mse": 4.2e-3, "energy_mse_median": 4.2e-3, "train_seconds": 300.0},
    "pixels/black-box-hnn": {"energy_mse": 1.5e-4, "energy_mse_over_baseline": 0.1, "train_seconds": 300.0},
}
"""Bounds for the model that suits the scene."""
SHOWN = (
    *("test_loss", "clean_field_mse", "energy_mse", "energy_mse_standard_error", "energy_mse_median"),
    *("energy_mse_over_baseline", "published_energy_mse", "rollout_mse", "train_seconds", "compile_seconds"),
)


def cases(
    names: Sequence[str] = tuple(name for name in TASKS if name != REAL),
    *,
    seeds: int = 3,
    steps: int | None = None,
    trajectories: int | None = None,
    real_pendulum: Path | None = None,
    folder: Path | None = None,
) -> list[Case]:
    """One case per task, with all its models; `InputError` for a number that is not positive.

    `steps` of a fit default to the task's own and `trajectories` to the published number; the measured task needs the
    file `real_pendulum`. With a `folder`, a task's figure is drawn as soon as the task is measured.
    """
    counts = {"steps": steps, "trajectories": trajectories}
    require_positive(seeds=seeds, **{key: value for key, value in counts.items() if value is not None})
    listed = []
    for name in names:
        task = pixel_task if name == PIXELS else partial(phase_task, name, data=real_pendulum if name == REAL else None)
        kinds = MODELS if name == PIXELS else models_of(name)
        measure = partial(task, seeds=seeds, folder=folder, **counts)
        listed.append(Case(name, measure, {f"{name}/{kind}": () for kind in kinds}))
    return listed


def models_of(task: str) -> tuple[str, ...]:
    """Models of a task; the first is the one that suits the scene."""
    every = (RECIPES[task].suits, *MODELS)
    return (*every, POLYNOMIAL) if task in ("spring", "pendulum") else every


def phase_task(
    name: str, *, seeds: int, steps: int | None, trajectories: int | None, data: Path | None, folder: Path | None
) -> Findings:
    """Measures all models of a task in coordinates and momenta, and draws its figure."""
    problem = problem_of(name, trajectories=trajectories, data=data)
    options: dict[str, Any] = {"steps": steps, "seconds": RECIPES[name].seconds}
    rows: list[Row] = []
    seen: dict[str, Seen] = {}
    for kind in models_of(name):
        description = description_of(problem, kind)
        # Every seed compiles anew, as a user's run does.
        runs = [measured_once(problem, train(problem, description, seed=seed, **options)) for seed in range(seeds)]
        rows += rows_of(f"{name}/{kind}", medians(runs))
        seen[kind] = runs[0][1]
    if folder is not None:
        write_figure(folder / f"{name}.png", figure_of(problem, seen))
    return Findings(rows)


def pixel_task(*, seeds: int, steps: int | None, trajectories: int | None, folder: Path | None) -> Findings:
    """Measures the models of images, and draws an animation and figures."""
    data = pixels.pixel_data(trajectories)
    numbers, seen = {}, {}
    for kind in MODELS:
        runs = [pixels.measure_pixels(kind, data, seed=seed, steps=steps) for seed in range(seeds)]
        numbers[kind], seen[kind] = medians(runs), runs[0][1]
    energetic, baseline = (numbers[kind] for kind in MODELS)
    energetic["energy_mse_over_baseline"] = energetic["energy_mse"] / baseline["energy_mse"]
    if folder is not None:
        for name, draw in pixels.figures_of(seen, data).items():
            draw(folder / name)
    return Findings([row for kind, of_kind in numbers.items() for row in rows_of(f"{PIXELS}/{kind}", of_kind)])


def medians(runs: Sequence[tuple[dict[str, float], *tuple[Any, ...]]]) -> dict[str, float]:
    """Medians of all quantities over the seeds, and the largest energy error."""
    of_seeds = [numbers for numbers, *_ in runs]
    numbers = {key: float(np.median([seed[key] for seed in of_seeds])) for key in of_seeds[0]}
    numbers["energy_mse_largest"] = float(np.max([seed["energy_mse"] for seed in of_seeds]))
    return {key: value for key, value in numbers.items() if not np.isnan(value)}


def table_rows(rows: Sequence[Row]) -> list[Row]:
    """Adds units, published references and bounds; Hamiltonian networks refer to the published one."""
    return [
        row._replace(
            unit=unit_of(row.quantity),
            reference=beside(row.case, row.quantity),
            bound=BOUNDS.get(row.case, {}).get(row.quantity),
        )
        for row in rows
    ]


def beside(case: str, quantity: str) -> float | None:
    """The published number to compare a model with: the baseline's, or the Hamiltonian network's."""
    task, kind = case.split("/")
    name = kind if kind == "phase-network" else "black-box-hnn"
    return published(HAMILTONIAN, f"{task}/{name}", quantity)
