"""Train Hamiltonian models and baselines on the published tasks, and print their errors beside the published ones.

Models: what suits the scene (separable-hnn or pairwise-hnn, with friction where it has it), black-box-hnn (one network
is H), phase-network (one gives the rates). Each is trained on the published data (those of seed 0) from several seeds;
numbers are medians over these. The real pendulum is measured where its file is given.

--only own --own FOLDER compares instead: files TASK-SEED.npz of the published protocols, learned as own data
(train_hnn_task --task measured) with their needs stated and without, beside the named tasks on the same starts.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.commands.phase_spaces.data import MEASURED, REAL, PhaseLog, generate, read_motions
from dln_jax.commands.phase_spaces.models import choose_model, description_of
from dln_jax.commands.phase_spaces.results import errors, predicted_motions
from dln_jax.commands.phase_spaces.training import POLYNOMIAL, PhaseFit, train
from dln_jax.commands.pixel_films import TRAJECTORIES, swinging_rod
from dln_jax.commands.pixels import fit, measure
from dln_jax.learning.engine.checkpoint import Context
from dln_jax.metrics.phase_space import Motions, motion_errors, predict
from dln_jax.models.latent_phase import Field
from dln_jax.scenes.datasets.hamiltonian_tasks import PROTOCOLS
from dln_jax.types import InputError, require_positive
from scripts.reports.run import Case, Numbers

TINY = {"seeds": 1, "steps": 5, "trajectories": 10}
# Greydanus, Dzamba and Yosinski (2019): their baseline and their Hamiltonian network; those of pixels are of other
# pictures, and of an energy in other units.
PUBLISHED = {
    "spring": ({"test_loss": 3.67e-2, "energy_mse": 1.7e-1}, {"test_loss": 3.59e-2, "energy_mse": 3.8e-4}),
    "pendulum": (
        {"test_loss": 3.53e-2, "published_energy_mse": 4.2e-2},
        {"test_loss": 3.56e-2, "published_energy_mse": 2.5e-2},
    ),
    "real-pendulum": ({"energy_mse": 3.9e-1}, {"energy_mse": 1.4e-2}),
    "two-body": ({"test_loss": 3.0e-5, "energy_mse": 6.3e-2}, {"test_loss": 2.8e-6, "energy_mse": 3.9e-5}),
    "three-body": ({"test_loss": 3.8e-1, "energy_mse": 1.1e2}, {"test_loss": 4.9e-1, "energy_mse": 4.2e-2}),
    "pixels": ({"test_loss": 1.73e-4, "energy_mse": 9.3e-3}, {"test_loss": 1.85e-4, "energy_mse": 1.5e-4}),
}
# Bounds for the model that suits the scene.
BOUNDS = {
    "spring": ("separable-hnn", {"energy_mse": 3.8e-5, "train_seconds": 5.0}),
    "pendulum": ("separable-hnn", {"published_energy_mse": 2.5e-3, "train_seconds": 8.0}),
    "real-pendulum": ("separable-hnn", {"energy_mse": 8e-4, "train_seconds": 60.0}),
    "two-body": ("pairwise-hnn", {"energy_mse": 3.9e-6, "train_seconds": 30.0}),
    "three-body": ("pairwise-hnn", {"energy_mse": 4.2e-3, "energy_mse_median": 4.2e-3, "train_seconds": 300.0}),
    "pixels": ("black-box-hnn", {"energy_mse": 1.5e-4, "energy_mse_over_baseline": 0.1, "train_seconds": 300.0}),
}
SECONDS = {"two-body": 25.0, "three-body": 45.0, REAL: 30.0}
"""Time limits for both fits of a model together, compilation included; 60 s for other tasks."""
MODELS: tuple[Field, ...] = ("black-box-hnn", "phase-network")
"""Models of every task, in addition to the one that suits the scene."""


def phase_task(*, task: str, seeds: int = 3, steps: int | None = None, trajectories: int | None = None) -> Numbers:
    """All models of a task in coordinates and momenta, on the published data of seed 0.

    `steps` of a fit default to the task's own and `trajectories` to the published number.
    """
    return measured(generate(task, trajectories), seeds, steps)


def real_pendulum(*, real_pendulum: Path | None = None, seeds: int = 3, steps: int | None = None) -> Numbers:
    """The same for the measured pendulum (Schmidt and Lipson 2009), whose npz is no part of the project."""
    return {} if real_pendulum is None else measured(read_motions(REAL, real_pendulum), seeds, steps)


def measured(log: PhaseLog, seeds: int, steps: int | None) -> Numbers:
    """Medians over seeds, each of which compiles anew, as a user's run does."""
    numbers = {}
    for kind in (log.task.suits, *MODELS, *([POLYNOMIAL] if log.name in ("spring", "pendulum") else [])):
        runs, description = [], description_of(log, kind)
        for seed in range(seeds):
            context = Context(seed=seed).within(SECONDS.get(log.name, 60.0))
            fit = train(log, description, context, steps=steps)
            runs.append(errors(log, fit, predicted_motions(log, fit)))
        numbers[f"{log.name}/{kind}"] = medians(runs)
    return numbers


def images(*, seeds: int = 3, steps: int | None = None, trajectories: int | None = None) -> Numbers:
    """Models of images."""
    (*fitted, test), numbers = swinging_rod(trajectories or TRAJECTORIES), {}
    for kind in MODELS:
        fits = (fit(kind, *fitted, seed=seed, steps=steps) for seed in range(seeds))
        numbers[f"pixels/{kind}"] = medians([measure(*one, test)[0] for one in fits])
    energetic, baseline = numbers.values()
    energetic["energy_mse_over_baseline"] = energetic["energy_mse"] / baseline["energy_mse"]
    return numbers


def medians(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Medians of all quantities over the seeds, and the largest energy error."""
    require_positive(seeds=len(runs))
    numbers = {key: float(np.median([run[key] for run in runs])) for key in runs[0]}
    numbers["energy_mse_largest"] = max(run["energy_mse"] for run in runs)
    return {key: value for key, value in numbers.items() if not np.isnan(value)}


def own_files(
    *, own: Path | None = None, tasks: tuple[str, ...] = tuple(PROTOCOLS), seeds: int = 3, steps: int | None = None
) -> Numbers:
    """Energy errors of files TASK-SEED.npz, learned as own data with and without stated needs, and of the named tasks.

    Files have coordinates, momenta and their rates, generated by any program from the published protocol. Noise in the
    states makes the error of any fit vary tenfold between draws of a file, so the recipe of the named task is also
    fitted to all noisy files. There is no time limit, so that results do not depend on the machine's load.

    Raises:
        InputError: the folder has no such file.
    """
    files = {task: paths for task in tasks if own and (paths := sorted(own.glob(f"{task}-*.npz")))}
    if not files:
        raise InputError(
            f"--own {own} has no files such as spring-101.npz of the tasks {', '.join(tasks)}; "
            "python -m tests.published_motions FOLDER writes some"
        )
    numbers = {}
    for task, paths in files.items():
        named = generate(task)
        recipe = description_of(named, "auto")
        fits: list[tuple[str, PhaseLog, dict[str, Any], int]] = [("named-task", named, recipe, k) for k in range(seeds)]
        for path in paths:
            stated = read_motions(MEASURED, path, needs=named.needs)
            own_data = {"own-files": stated, "own-files-without-needs": read_motions(MEASURED, path)}
            fits += [(kind, one, choose_model(one), 0) for kind, one in own_data.items()]
            if named.task.weights is not None:  # the task has noise
                fits.append(("named-recipe-on-the-files", named._replace(fitted=stated.fitted), recipe, 0))
        of_kinds: dict[str, list[float]] = {}
        for kind, log, description, seed in fits:
            fit = train(log, description, Context(seed=seed), steps=steps)
            of_kinds.setdefault(kind, []).append(energy_error(named, fit))
        for kind, values in of_kinds.items():
            row = {"energy_mse": np.median(values), "energy_mse_largest": max(values), "trainings": len(values)}
            over = {"over_named_task": np.median(values) / np.median(of_kinds["named-task"])}
            numbers[f"{task}/{kind}"] = row | (over if kind.startswith("own-files") else {})
    return numbers


def energy_error(named: PhaseLog, fit: PhaseFit) -> float:
    """Mean square error of the task's energy along motions from its test starts."""
    description, d = fit.description, named.needs.degrees_of_freedom
    order = np.arange(d)
    if description.get("order") == "axes":  # the task's own coordinates go body by body
        order = order.reshape(-1, description["dimension"]).T.ravel()
    back = np.argsort(order)
    predicted = []
    for true in named.truth:
        moved = predict(fit.model, fit.parameters, true.q[:, 0, order], true.p[:, 0, order], true.t)
        predicted.append(Motions(moved.t, moved.q[..., back], moved.p[..., back]))
    return motion_errors(predicted, named.truth, named.energy)["energy_mse"]


FUNCTIONS = {"real-pendulum": real_pendulum, "pixels": images}


def published(task: str) -> dict[str, float]:
    """Numbers of the published network for every model but the baseline."""
    baseline, network = PUBLISHED[task]
    return {**network, **{f"{task}/phase-network {quantity}": value for quantity, value in baseline.items()}}


CASES = (
    *(
        Case(
            task,
            FUNCTIONS.get(task, phase_task),
            {} if task in FUNCTIONS else {"task": task},
            TINY if task != "real-pendulum" else {"seeds": 1, "steps": 5},
            published(task),
            {f"{task}/{model} {quantity}": bound for quantity, bound in bounds.items()},
        )
        for task, (model, bounds) in BOUNDS.items()
    ),
    Case("own", own_files, quick={"seeds": 1, "steps": 5}, bound={"over_named_task": 2.0}, by_name_only=True),
)
