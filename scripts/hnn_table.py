"""Train Hamiltonian models and baselines on the published tasks, and print their errors beside the published ones.

Tasks: spring, pendulum, real-pendulum, two-body and three-body. Models: hnn (what suits the scene: separable, pairwise,
with friction where the scene has it), black-box-hnn (one network is H), baseline (a network gives the rates). Each is
trained on the published data (those of seed 0) from several seeds; numbers are medians over these. Prints a table,
writes report.json, and draws each task's motions and energies.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from dln_jax.evaluation.report import Row, conditions, write_report
from dln_jax.types import InputError, require_positive
from scripts.command_line import CONFIG, new_folder, run, stored_arguments, with_stored_arguments, write_json
from scripts.hnn_measures import Seen, figure_of, measured_once
from scripts.hnn_models import description_of, models_of, train
from scripts.hnn_tasks import REAL, Problem, problem_of
from scripts.report_table import print_report

TASKS = ("spring", "pendulum", REAL, "two-body", "three-body")
"""The published ones."""
JOBS = "jobs.json"
"""What has been measured so far, for --resume."""


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    tasks: str = ",".join(TASKS)
    """Comma separated, from spring, pendulum, real-pendulum, two-body, three-body."""
    real_pendulum: Path | None = None
    """The measured pendulum (Schmidt and Lipson 2009) in the npz schema; without it that task is left out."""
    seeds: int = 3
    """Seeds of each model: 0, 1, ..."""
    trajectories: int | None = None
    """Generated trajectories of each task, for a trial (default: as published)."""
    steps: int | None = None
    """Iterations of each fit (default: each task's own)."""
    out: Path | None = None
    """Folder for report.json and the figures (default: runs/hnn_table-1, -2, ...)."""
    resume: bool = False
    """Continue the measurement in --out."""
    figures: bool = True
    """Draw the figures."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    console = Console(highlight=False, soft_wrap=True)
    if given.resume:
        given = with_stored_arguments(given)
        if given.real_pendulum is not None:
            given = replace(given, real_pendulum=Path(given.real_pendulum))
    names = chosen_tasks(given)
    folder = given.out if given.resume and given.out else new_folder(given.out, "hnn_table")
    write_json(folder / CONFIG, stored_arguments(given))
    stored = folder / JOBS
    found: dict[str, dict[str, float]] = json.loads(stored.read_text()) if given.resume and stored.is_file() else {}
    if REAL not in names and REAL in given.tasks.split(","):
        console.print(f"{REAL} is left out: its data are not part of this project; give them by --real-pendulum FILE")
    for name in names:
        if all(f"{name}/{kind}" in found for kind in models_of(name)):
            continue
        problem = problem_of(name, trajectories=given.trajectories, data=given.real_pendulum if name == REAL else None)
        seen: dict[str, Seen] = {}
        for kind in models_of(name):
            numbers, seen[kind] = measure(problem, kind, seeds=range(given.seeds), steps=given.steps)
            found[f"{name}/{kind}"] = numbers
            console.print(f"{name}/{kind:14s} {summary(numbers)}")
        if given.figures:
            figure_of(problem, seen).savefig(folder / f"{name}.png")
        write_json(stored, found)
    rows = [row for case, numbers in found.items() for row in rows_of(case, numbers)]
    facts = conditions(
        dtype="float64",
        seeds=list(range(given.seeds)),
        selection="parameters by validation trajectories alone; sizes and budgets are the same for all seeds",
        data="published protocols, seed 0",
        statistics="medians over seeds; compilation is apart from train_seconds",
    )
    write_report(folder / "report.json", rows, facts)
    print_report([row for row in rows if row.quantity in SHOWN], facts)
    print(f"report: {folder / 'report.json'}")


def chosen_tasks(given: Arguments) -> list[str]:
    """The tasks that can be measured; checks the arguments before anything is written."""
    require_positive(seeds=given.seeds)
    for key in ("steps", "trajectories"):
        if getattr(given, key) is not None:
            require_positive(**{key: getattr(given, key)})
    names = given.tasks.split(",")
    for name in names:
        if name not in TASKS:
            raise InputError(f"task '{name}' is unknown; choose from {', '.join(TASKS)}")
    if given.real_pendulum is None:
        names = [name for name in names if name != REAL]
        if not names:
            raise InputError(f"{REAL} needs its data, which are not part of this project; give --real-pendulum FILE")
    elif REAL in names:
        problem_of(REAL, data=given.real_pendulum)
    return names


def measure(problem: Problem, kind: str, *, seeds: Sequence[int], steps: int | None) -> tuple[dict[str, float], Seen]:
    """Medians over seeds of a model's errors and times, and what the first seed predicts."""
    description = description_of(problem, kind)
    # Each seed pays for its own compilation, as a user does.
    runs = [measured_once(problem, train(problem, description, seed=seed, steps=steps)) for seed in seeds]
    of_seeds = [numbers for numbers, _ in runs]
    medians = {key: float(np.median([each[key] for each in of_seeds])) for key in of_seeds[0]}
    worst = {"energy_mse_largest": float(np.max([each["energy_mse"] for each in of_seeds]))}
    return {key: value for key, value in (medians | worst).items() if not np.isnan(value)}, runs[0][1]


PUBLISHED = {
    "spring": {"test_loss": (3.67e-2, 3.59e-2), "energy_mse": (1.7e-1, 3.8e-4)},
    "pendulum": {"test_loss": (3.53e-2, 3.56e-2), "published_energy_mse": (4.2e-2, 2.5e-2)},
    REAL: {"energy_mse": (3.9e-1, 1.4e-2)},
    "two-body": {"test_loss": (3.0e-5, 2.8e-6), "energy_mse": (6.3e-2, 3.9e-5)},
    "three-body": {"test_loss": (3.8e-1, 4.9e-1), "energy_mse": (1.1e2, 4.2e-2)},
}
"""Of the published baseline and Hamiltonian network (Greydanus, Dzamba and Yosinski 2019)."""
BOUNDS = {
    "spring": {"energy_mse": 3.8e-5, "train_seconds": 5.0},
    "pendulum": {"published_energy_mse": 2.5e-3, "train_seconds": 8.0},
    REAL: {"energy_mse": 8e-4, "train_seconds": 60.0},
    "two-body": {"energy_mse": 3.9e-6, "train_seconds": 30.0},
    "three-body": {"energy_mse": 4.2e-3, "energy_mse_median": 4.2e-3, "train_seconds": 300.0},
}
"""For the model that suits the scene."""
SHOWN = (
    *("test_loss", "clean_field_mse", "energy_mse", "energy_mse_standard_error", "energy_mse_median"),
    *("published_energy_mse", "rollout_mse", "train_seconds", "compile_seconds"),
)


def rows_of(case: str, numbers: dict[str, float]) -> list[Row]:
    """The report's rows of a case, with the published value and the bound where there are."""
    task, kind = case.split("/")
    rows = []
    for quantity, value in numbers.items():
        published = PUBLISHED[task].get(quantity)
        reference = None if published is None else published[0 if kind == "baseline" else 1]
        bound = BOUNDS[task].get(quantity) if kind == "hnn" else None
        unit = "s" if quantity.endswith("seconds") else "1"
        rows.append(Row(case, quantity, value, unit, reference, bound))
    return rows


def summary(numbers: dict[str, float]) -> str:
    """A line of the most telling numbers."""
    shown = ("clean_field_mse", "energy_mse", "published_energy_mse", "train_seconds", "compile_seconds")
    return "  ".join(f"{key} {numbers[key]:.3g}" for key in shown if key in numbers)


if __name__ == "__main__":
    run(main, Arguments)
