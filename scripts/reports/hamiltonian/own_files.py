"""Files of the published tasks, learned as a user's own data, beside the named tasks: energy errors on the same starts.

A file TASK-SEED.npz has coordinates, momenta and their rates, made by any program from the published protocol. It is
learned as `train_hnn_task --task measured` does, with the needs stated and without. Noise in the states makes the error
of any fit scatter by a factor of ten between draws of a file, so the recipe of the named task is also fitted to the
samples of each noisy file.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.metrics.phase_space import Motions, motion_errors, predict
from dln_jax.metrics.report import Row, markdown_table
from dln_jax.training.hamiltonian.model_selection import choose_model, description_of
from dln_jax.training.hamiltonian.recipes import RECIPES
from dln_jax.training.hamiltonian.tasks import HORIZONS, MEASURED, Problem, Stated, problem_of
from dln_jax.training.hamiltonian.training import Trained, train
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build
from scripts.reports.case import Case, Findings, by_case, rows_of

NAMED, RECIPE, STATED, DEFAULT = "named-task", "named-recipe-on-the-files", "own-files", "own-files-without-needs"
FACTOR = 2.0
"""Own files may have an energy error that is this many times that of the named task."""
QUANTITIES = ("energy_mse", "energy_mse_largest")


def files_of(folder: Path, tasks: Sequence[str]) -> dict[str, list[Path]]:
    """Files TASK-SEED.npz of a folder by task.

    Raises:
        InputError: there is none.
    """
    found = {task: sorted(folder.glob(f"{task}-*.npz")) for task in tasks if task in HORIZONS}
    found = {task: files for task, files in found.items() if files}
    if not found:
        raise InputError(
            f"{folder} has no files such as spring-101.npz of the tasks {', '.join(tasks)}; "
            "python -m tests.published_motions FOLDER writes some"
        )
    return found


def own_cases(
    folder: Path, tasks: Sequence[str], *, seeds: int, steps: int | None, report: Callable[[str], None]
) -> list[Case]:
    """A case for each task that the folder has files of.

    Args:
        folder: of the files.
        tasks: names.
        seeds: trainings of the named task, from seeds 0, 1, ...
        steps: iterations of each fit (default: the recipe's).
        report: called with a line after each training.
    """
    cases = []
    for task, files in files_of(folder, tasks).items():
        measure = partial(measured, task, files, seeds=seeds, steps=steps, report=report)
        cases.append(Case(f"{task}/own", measure, {f"{task}/{kind}": QUANTITIES for kind in (NAMED, STATED, DEFAULT)}))
    return cases


def measured(
    task: str, files: Sequence[Path], *, seeds: int, steps: int | None, report: Callable[[str], None]
) -> Findings:
    """Medians and largest energy errors of the named task over seeds, and of own data over files.

    Nothing is limited in time, so that a busy machine measures the same.
    """
    named, errors = problem_of(task), dict[str, list[float]]()
    recipe = description_of(named, "auto")

    def fit(kind: str, problem: Problem, description: dict[str, Any], of: str, seed: int = 0) -> None:
        error = energy_error(named, train(problem, description, seed=seed, steps=steps))
        errors.setdefault(kind, []).append(error)
        report(f"{task}/{kind}, {of}: energy_mse {error:.2e}")

    for seed in range(seeds):
        fit(NAMED, named, recipe, f"seed {seed}", seed)
    for file in files:
        stated = problem_of(MEASURED, data=file, stated=Stated(named.needs))
        default = problem_of(MEASURED, data=file)
        for kind, problem in {STATED: stated, DEFAULT: default}.items():
            fit(kind, problem, choose_model(problem, precision="f64"), file.name)
        if RECIPES[task].weights is not None:  # the task has noise
            fit(RECIPE, named._replace(fitted=stated.fitted), recipe, file.name)
    rows = []
    for kind, each in errors.items():
        numbers = {"energy_mse": float(np.median(each)), "energy_mse_largest": float(np.max(each))}
        rows += rows_of(f"{task}/{kind}", numbers | {"trainings": float(len(each))})
    return Findings(rows)


def energy_error(named: Problem, trained: Trained) -> float:
    """Mean square error of the task's energy along motions from its test starts."""
    description, d = trained.description, named.needs.degrees_of_freedom
    order = np.arange(d)
    if description.get("order") == "axes":  # the task's own coordinates go body by body
        order = order.reshape(-1, description["dimension"]).T.ravel()
    model, back = build(description), np.argsort(order)
    predicted = []
    for true in named.truth:
        moved = predict(model, trained.result.parameters, true.q[:, 0, order], true.p[:, 0, order], true.t)
        predicted.append(Motions(moved.t, moved.q[..., back], moved.p[..., back]))
    return motion_errors(predicted, named.truth, named.energy)["energy_mse"]


def compared(rows: Sequence[Row]) -> list[Row]:
    """The rows of own files with the median of the named task as their reference, and `FACTOR` times it as a bound."""
    numbers = by_case(rows)

    def beside(row: Row) -> Row:
        task, kind = row.case.split("/")
        if row.quantity != "energy_mse" or kind not in (STATED, DEFAULT):
            return row
        named = numbers[f"{task}/{NAMED}"]["energy_mse"]
        return row._replace(reference=named, bound=FACTOR * named)

    return [beside(row) for row in rows]


def own_markdown(rows: Sequence[Row]) -> str:
    """Median energy errors, and the largest in brackets, a line a task."""
    numbers = by_case(rows)
    tasks = list(dict.fromkeys(case.split("/")[0] for case in numbers))

    def cell(task: str, kind: str) -> str:
        found = numbers.get(f"{task}/{kind}")
        return "" if found is None else f"{found['energy_mse']:.1e} ({found['energy_mse_largest']:.1e})"

    kinds = (NAMED, RECIPE, STATED, DEFAULT)
    return markdown_table(["task", *(kind.replace("-", " ") for kind in kinds)], [
        [task, *(cell(task, kind) for kind in kinds)] for task in tasks
    ])  # fmt: skip
