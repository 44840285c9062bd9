"""Train Hamiltonian models and baselines on the published tasks, and print their errors beside the published ones.

Tasks: spring, pendulum, real-pendulum, two-body, three-body and pixels. Models: hnn (what suits the scene: separable,
pairwise, with friction where the scene has it), black-box-hnn (one network is H), baseline (a network gives the rates).
Each is trained on the published data (those of seed 0) from several seeds; numbers are medians over these. Prints a
table, writes report.json and table.md, and draws each task's motions and energies.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import Console

from dln_jax.command_line.arguments import Unstated, choice, names_in
from dln_jax.command_line.running import stored_arguments, with_stored_arguments
from dln_jax.files import CONFIG, run_folder, write_bytes, write_figure, write_json
from dln_jax.studies.hamiltonian import pixels
from dln_jax.studies.hamiltonian.measures import Seen, figure_of, measured_once
from dln_jax.studies.hamiltonian.published import PIXELS, markdown, rows_of
from dln_jax.studies.hamiltonian.tasks import REAL, problem_of
from dln_jax.studies.hamiltonian.training import RECIPES, description_of, models_of, train
from dln_jax.studies.jobs import JOBS, stored_jobs
from dln_jax.studies.report import conditions, write_report
from dln_jax.studies.report_table import print_report
from dln_jax.types import InputError, require_positive

TASKS = ("spring", "pendulum", REAL, "two-body", "three-body", PIXELS)
"""The published ones."""


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    tasks: Annotated[str, choice(TASKS, several=True)] = ",".join(TASKS)
    """Tasks (default: all)."""
    real_pendulum: Unstated[Path] = None
    """The measured pendulum (Schmidt and Lipson 2009) in the npz schema; without it that task is left out."""
    seeds: int = 3
    """Seeds of each model: 0, 1, ..."""
    trajectories: Unstated[int] = None
    """Generated trajectories of each task, for a trial (default: as published)."""
    steps: Unstated[int] = None
    """Iterations of each fit (default: each task's own)."""
    out: Unstated[Path] = None
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
    names = chosen_tasks(given)
    with run_folder(given.out, "hnn_table", resume=given.resume) as folder:
        measure_into(folder, given, names, console)


def measure_into(folder: Path, given: Arguments, names: list[str], console: Console) -> None:
    """Measures what has not been measured yet, and writes and prints the table."""
    known = {f"{name}/{kind}": () for name in names for kind in (pixels.KINDS if name == PIXELS else models_of(name))}
    found = stored_jobs(folder, known) if given.resume else {}
    write_json(folder / CONFIG, stored_arguments(given))
    if REAL not in names and REAL in given.tasks.split(","):
        console.print(f"{REAL} is left out: its data are not part of this project; give them by --real-pendulum FILE")
    for name in names:
        if any(case.startswith(f"{name}/") for case in found):
            continue
        measured = pixel_task(given, folder) if name == PIXELS else phase_task(name, given, folder)
        for kind, numbers in measured.items():
            found[f"{name}/{kind}"] = numbers
            console.print(f"{name}/{kind:14s} {summary(numbers)}")
        write_json(folder / JOBS, found)
    rows = [row for case, numbers in found.items() for row in rows_of(case, numbers)]
    facts = conditions(
        dtype="float64",
        seeds=list(range(given.seeds)),
        selection="parameters by validation trajectories alone; sizes and budgets are the same for all seeds",
        data="published protocols, seed 0",
        limits="seconds of a training, compilation included: "
        + ", ".join(f"{name} {RECIPES[name].seconds:g}" for name in names if name != PIXELS),
        statistics="medians over seeds; compilation is apart from train_seconds",
    )
    write_report(folder / "report.json", rows, facts)
    table = markdown(found)
    write_bytes(folder / "table.md", table.encode())
    print_report([row for row in rows if row.quantity in SHOWN], facts)
    print(table)
    print(f"report: {folder / 'report.json'}, table: {folder / 'table.md'}")


def chosen_tasks(given: Arguments) -> list[str]:
    """The tasks that can be measured; checks the arguments before anything is written."""
    require_positive(seeds=given.seeds)
    for key in ("steps", "trajectories"):
        if getattr(given, key) is not None:
            require_positive(**{key: getattr(given, key)})
    names = names_in("--tasks", given.tasks, TASKS)
    if given.real_pendulum is None:
        names = [name for name in names if name != REAL]
        if not names:
            raise InputError(f"{REAL} needs its data, which are not part of this project; give --real-pendulum FILE")
    elif REAL in names:
        problem_of(REAL, data=given.real_pendulum)
    return names


def phase_task(name: str, given: Arguments, folder: Path) -> dict[str, dict[str, float]]:
    """Every model of a task in coordinates and momenta, and its figure."""
    problem = problem_of(name, trajectories=given.trajectories, data=given.real_pendulum if name == REAL else None)
    found: dict[str, dict[str, float]] = {}
    seen: dict[str, Seen] = {}
    for kind in models_of(name):
        description = description_of(problem, kind)
        # Each seed pays for its own compilation, as a user does.
        runs = [
            measured_once(
                problem,
                train(problem, description, seed=seed, steps=given.steps, seconds=RECIPES[name].seconds),
            )
            for seed in range(given.seeds)
        ]
        found[kind], seen[kind] = medians([numbers for numbers, _ in runs]), runs[0][1]
    if given.figures:
        write_figure(folder / f"{name}.png", figure_of(problem, seen))
    return found


def pixel_task(given: Arguments, folder: Path) -> dict[str, dict[str, float]]:
    """The models of pictures, and their animation and pictures."""
    found, seen = {}, {}
    for kind in pixels.KINDS:
        runs = [
            pixels.measure_pixels(kind, seed=seed, steps=given.steps, trajectories=given.trajectories)
            for seed in range(given.seeds)
        ]
        found[kind], seen[kind] = medians([numbers for numbers, _ in runs]), runs[0][1]
    found["hnn"]["energy_mse_over_baseline"] = found["hnn"]["energy_mse"] / found["baseline"]["energy_mse"]
    if given.figures:
        pixels.draw_pixels(seen, pixels.pixel_data(given.trajectories), folder)
    return found


def medians(of_seeds: list[dict[str, float]]) -> dict[str, float]:
    """Of each quantity over the seeds, and the largest energy error."""
    found = {key: float(np.median([each[key] for each in of_seeds])) for key in of_seeds[0]}
    worst = {"energy_mse_largest": float(np.max([each["energy_mse"] for each in of_seeds]))}
    return {key: value for key, value in (found | worst).items() if not np.isnan(value)}


SHOWN = (
    *("test_loss", "clean_field_mse", "energy_mse", "energy_mse_standard_error", "energy_mse_median"),
    *("energy_mse_over_baseline", "published_energy_mse", "rollout_mse", "train_seconds", "compile_seconds"),
)


def summary(numbers: dict[str, float]) -> str:
    """A line of the most telling numbers."""
    shown = ("clean_field_mse", "energy_mse", "published_energy_mse", "train_seconds", "compile_seconds")
    return "  ".join(f"{key} {numbers[key]:.3g}" for key in shown if key in numbers)
