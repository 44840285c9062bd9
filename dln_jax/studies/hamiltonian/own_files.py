"""Files of the published tasks, learned as a user's own data, beside the named tasks: energy errors on the same starts.

A file TASK-SEED.npz has coordinates, momenta and their rates, made by any program from the published protocol. It is
learned as `train_hnn_task --task measured` does, with the needs stated and without. Noise in the states makes the error
of any fit scatter by a factor of ten between draws of a file, so the recipe of the named task is also fitted to the
samples of each noisy file.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.metrics.phase_space import Motions, motion_errors, predict
from dln_jax.studies.case import Case, Findings, by_case, rows_of
from dln_jax.studies.hamiltonian.choice import choose_model, description_of
from dln_jax.studies.hamiltonian.recipes import RECIPES
from dln_jax.studies.hamiltonian.tasks import HORIZONS, MEASURED, Problem, Stated, problem_of
from dln_jax.studies.hamiltonian.training import Trained, train
from dln_jax.studies.report import Row, markdown_table
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build

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


def own_cases(folder: Path, tasks: Sequence[str], *, seeds: int, steps: int | None) -> list[Case]:
    """A case for each task of which the folder has files; the named task is trained from so many seeds."""
    cases = []
    for task, files in files_of(folder, tasks).items():
        measure = partial(measured, task, files, seeds=seeds, steps=steps)
        cases.append(Case(f"{task}/own", measure, {f"{task}/{kind}": QUANTITIES for kind in (NAMED, STATED, DEFAULT)}))
    return cases


def measured(task: str, files: Sequence[Path], *, seeds: int, steps: int | None) -> Findings:
    """Medians and largest energy errors of the named task over seeds, and of own data over files."""
    named = problem_of(task)
    options: dict[str, Any] = {"steps": steps, "seconds": RECIPES[task].seconds}
    recipe = description_of(named, "auto")
    errors: dict[str, list[float]] = {
        NAMED: [energy_error(named, train(named, recipe, seed=seed, **options)) for seed in range(seeds)]
    }
    for file in files:
        own = {
            STATED: problem_of(MEASURED, data=file, stated=Stated(named.needs)),
            DEFAULT: problem_of(MEASURED, data=file),
        }
        noisy = own[STATED].trust is None or not own[STATED].trust.free_of_noise
        if noisy:
            same = named._replace(fitted=own[STATED].fitted)
            errors.setdefault(RECIPE, []).append(energy_error(named, train(same, recipe, seed=0, **options)))
        for kind, problem in own.items():
            trained = train(problem, choose_model(problem, precision="f64"), seed=0, steps=steps)
            errors.setdefault(kind, []).append(energy_error(named, trained))
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
