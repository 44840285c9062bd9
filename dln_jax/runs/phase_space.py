"""Training a task of a phase space into a run folder: the model, its errors, its speed and its pictures."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from dln_jax.command_line.progress import progress
from dln_jax.figures import animations
from dln_jax.figures.style import TRUTH
from dln_jax.figures.training import training_curve
from dln_jax.files import write_figure, write_json
from dln_jax.learning.engine.problem import Progress
from dln_jax.metrics.latency import one_step
from dln_jax.runs.phase_space_task import PhaseTask
from dln_jax.studies.hamiltonian.table import Seen, figure_of, measured_once, units_of
from dln_jax.studies.hamiltonian.tasks import MEASURED, REAL, Problem
from dln_jax.studies.hamiltonian.training import MOTIONS, RATES, Trained, stages_of, train
from dln_jax.studies.speed.low_latency_calls import low_latency_metrics
from dln_jax.types import InputError
from dln_jax.zoo.run import load, save

GIF_FRAMES = 80
LOSSES = {
    RATES: "rates: mean square error of (qd, pd)",
    MOTIONS: "motions: mean square error of (q, p) over its weight",
}
"""What each stage makes small."""


def train_into(
    folder: Path, task: PhaseTask, *, resume: bool = False, figures: bool = True, low_latency: bool = True
) -> None:
    """Trains, evaluates, and writes the files of the run into an existing folder.

    Raises:
        InputError: no error is finite, or the loss stopped being so; what was good before that is kept.
    """
    console = Console(highlight=False, soft_wrap=True)
    problem, description, training = task
    announce(console, problem, description)
    with stage_progress(stages_of(problem, description, training["steps"])) as report:
        trained = train(problem, description, **training, directory=folder, resume=resume, report=report)
    if not np.isfinite(trained.result.validation):
        raise InputError(f"{trained.stopped}; {folder} holds no model")
    save(folder, description, trained.result.parameters)
    numbers, seen = measured_once(problem, trained)
    metrics = {**numbers, **latency_of(folder, problem), "validation_error": float(trained.result.validation)}
    if low_latency:
        truth = problem.truth[0]
        metrics |= low_latency_metrics(folder, (truth.q[0], truth.p[0]), console.print, function="rates")
    write_json(folder / "metrics.json", {key: value for key, value in metrics.items() if np.isfinite(value)})
    if figures:
        draw(folder, problem, description["name"], seen, trained)
    console.print(results_table(metrics, problem))
    console.print(f"run folder: {folder}")
    if trained.diverged:
        raise InputError(f"{trained.stopped}; {folder} holds the best model before that")
    if trained.stopped:
        console.print(trained.stopped)


@contextmanager
def stage_progress(stages: dict[str, int]) -> Iterator[Callable[[Progress], None]]:
    """Yields `report(at)`: the stages, one after the other, each with a count of its own."""
    with ExitStack() as shown:
        current = next(iter(stages), "")
        show = shown.enter_context(progress(stages[current])) if stages else None

        def report(at: Progress) -> None:
            nonlocal current, show
            if show is None or at.stage != current:
                shown.close()
                current, show = at.stage, shown.enter_context(progress(stages[at.stage]))
            show(at.step, f"{at.stage}: loss {at.loss:.2e}  validation {at.validation:.2e}")

        yield report


def announce(console: Console, problem: Problem, description: dict[str, Any]) -> None:
    """Says what is trained on what, and what was assumed."""
    data = problem.fitted
    trajectories = len(np.unique(data.trajectory))
    needs = problem.needs
    terms = " and ".join(name for name in ("gravity", "friction") if getattr(needs, name)) or "no potential"
    console.print(f"{problem.name}: {len(data.t)} samples of {trajectories} stretches for training and validation")
    console.print(f"{'-'.join(needs.joints)} with {terms}; {description['name']}, f64")
    missing = [key for key in data.estimated if key != "tau"]
    if missing:
        console.print(f"not in the data: {', '.join(missing)}; finite differences start the fit to motions")
    if problem.name in (REAL, MEASURED) and np.array_equal(data.p if data.p is not None else 0, data.qd):
        console.print("momenta p are taken as qd, per unit of inertia")


def latency_of(folder: Path, problem: Problem) -> dict[str, float]:
    """Of one call of the rates, of the stored model as a user loads it."""
    field, truth = load(folder).flow, problem.truth[0]
    states = list(zip(truth.q[0, :256], truth.p[0, :256], strict=True))
    found = one_step(field.rates, states, calls=2000)
    return {"one_step_p50_us": found.p50_us, "one_step_p99_us": found.p99_us}


def draw(folder: Path, problem: Problem, name: str, seen: Seen, trained: Trained) -> None:
    """Writes what there is to draw."""
    write_figure(folder / "motions.png", figure_of(problem, {name: seen}))
    truth = problem.truth[0]
    stride = max(1, len(truth.t) // GIF_FRAMES)
    motions, units = {TRUTH: truth, name: seen.motions}, units_of(problem)[:2]
    animations.write_motion_gif(folder / "motions.gif", motions, stride=stride, units=units)
    history = trained.history
    if len(history) > 1:
        best = history[-1].step - trained.result.history[-1].step + trained.result.best_step
        named = [at._replace(stage=LOSSES[at.stage]) for at in history]
        words = {"error": "loss", "loss": "training loss", "unit": "loss, of each stage in its own units"}
        write_figure(folder / "training.png", training_curve(named, best_step=best, **words))


MEANINGS = {
    "published_energy_mse": ("published energy along predicted motions, mean square error", "units of that energy²"),
    "energy_mse": ("energy along predicted motions, mean square error", "J²"),
    "rollout_mse": ("(q, p) of predicted motions, mean square error", "units of q² and p²"),
    "train_loss": ("(qd, pd) at training states, mean square error", "units of qd² and pd²"),
    "test_loss": ("(qd, pd) at test states, mean square error", "units of qd² and pd²"),
    "clean_field_mse": ("(qd, pd) against the exact field, mean square error", "units of qd² and pd²"),
    "validation_error": ("validation loss of the last stage", "see training.png"),
}
"""What a metric's name begins with, in words, and its unit; for an energy error 0 is that of the true plant."""
OF_STARTS = {"_standard_error": ": its standard error over starts", "_median": ": its median over starts"}
"""What the rest of such a name says."""
UNITS = {
    **dict.fromkeys(("train_seconds", "compile_seconds"), "s"),
    **{f"one_step_{mode}{quantile}_us": "µs" for mode in ("", "low_latency_") for quantile in ("p50", "p99")},
}


def results_table(metrics: dict[str, float], problem: Problem) -> Table:
    """Of numbers with their units."""
    table = Table(title=f"test motions of {problem.name}, f64")
    table.add_column("quantity")
    table.add_column("value", justify="right")
    table.add_column("unit")
    for name, value in metrics.items():
        if np.isfinite(value):
            quantity = next((key for key in MEANINGS if name.startswith(key)), None)
            meaning, unit = MEANINGS[quantity] if quantity else (name, UNITS.get(name, ""))
            rest = name.removeprefix(quantity or name)
            table.add_row(meaning.replace("_", " ") + OF_STARTS.get(rest, rest), f"{value:.4g}", unit)
    return table
