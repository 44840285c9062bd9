"""What `train_hnn --task` does: from a command line to a trained model of a phase space in a run folder."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table

from dln_jax.deploy.load import load_phase_field, save_model
from dln_jax.deploy.phase_kinds import build_phase
from dln_jax.evaluation import animations, figures
from dln_jax.evaluation.latency import one_step
from dln_jax.evaluation.phase_figures import TRUTH
from dln_jax.files import CONFIG, run_folder, write_figure, write_json
from dln_jax.learning.runs import Progress
from dln_jax.types import InputError, require_positive
from scripts.command_line import needs_from_option, stored_arguments
from scripts.hnn_measures import Seen, figure_of, measured_once
from scripts.hnn_models import KINDS, POLYNOMIAL, RECIPES, description_of, train
from scripts.hnn_tasks import MEASURED, REAL, Problem, problem_of
from scripts.low_latency_calls import low_latency_metrics
from scripts.progress import progress

if TYPE_CHECKING:
    from scripts.train_hnn import Arguments

GIF_FRAMES = 80
UNSUITABLE = ("test", "scene", "target")
"""Options of models of torques, which a task decides itself."""


def run_task(given: "Arguments") -> None:
    """Trains, evaluates, and writes the run folder."""
    console = Console(highlight=False, soft_wrap=True)
    check(given)
    needs = None if given.needs is None else needs_from_option(given.needs)
    problem = problem_of(given.task or "", trajectories=given.trajectories, data=given.data, needs=needs)
    size: dict[str, Any] = {"width": given.width, "depth": given.depth if given.depth != 2 else None}
    size["degree"] = given.degree if given.model == POLYNOMIAL and given.degree > 1 else None
    description = description_of(problem, given.model, activation=given.activation, **size)
    build_phase(description)  # refuses what does not suit, before anything is written
    with run_folder(given.out, "train_hnn", resume=given.resume) as folder:
        train_into(folder, given, problem, description, console)


def train_into(
    folder: Path, given: "Arguments", problem: Problem, description: dict[str, Any], console: Console
) -> None:
    """Trains, evaluates, and writes the files of the run."""
    write_json(folder / CONFIG, {**stored_arguments(given), "chosen": description})
    announce(console, problem, description)
    with progress(total_steps(problem, description, given.steps)) as show:
        trained = train(
            problem,
            description,
            seed=given.seed,
            optimizer="adam" if given.optimizer == "adam" else "gauss-newton",
            steps=given.steps,
            learning_rate=given.learning_rate,
            directory=folder,
            resume=given.resume,
            report=shown_by(show),
        )
    if not np.isfinite(trained.fits[-1].validation):
        raise InputError(f"the loss is not finite; {folder} holds no model: lower --learning-rate or check the data")
    save_model(folder, description, trained.fits[-1].parameters)
    numbers, seen = measured_once(problem, trained)
    metrics = {**numbers, **latency_of(folder, problem), "validation_error": float(trained.fits[-1].validation)}
    if given.low_latency:
        truth = problem.truth[0]
        metrics |= low_latency_metrics(folder, (truth.q[0], truth.p[0]), console.print, function="rates")
    write_json(folder / "metrics.json", {key: value for key, value in metrics.items() if np.isfinite(value)})
    if given.figures:
        draw(folder, problem, description["kind"], seen, trained.fits[-1].history)
    console.print(results_table(metrics, problem))
    console.print(f"run folder: {folder}")


def check(given: "Arguments") -> None:
    """Refuses what a task does not take, before anything is written."""
    require_positive(**{name: getattr(given, name) for name in ("depth", "learning_rate")})
    for name in ("width", "steps", "trajectories"):
        if getattr(given, name) is not None:
            require_positive(**{name: getattr(given, name)})
    for name in UNSUITABLE:
        if getattr(given, name) is not None:
            raise InputError(f"--{name} is for models of torques; leave it out with --task")
    if given.precision == "f32":
        raise InputError("tasks are fitted in f64; leave --precision out")
    if given.seeds != 1:
        raise InputError("a task trains one seed at a time; scripts.hnn_table measures several")
    if given.optimizer == "adam" and given.model == POLYNOMIAL:
        raise InputError("the polynomial model is one least-squares problem; leave --optimizer out")


def total_steps(problem: Problem, description: dict[str, Any], steps: int | None) -> int:
    """Iterations of all fits."""
    recipe = RECIPES[problem.name]
    rates = 0 if description["kind"] == KINDS[POLYNOMIAL] else steps or recipe.steps
    return max(rates + (steps or recipe.trajectory_steps if recipe.trajectory_steps else 0), 1)


def shown_by(show: Callable[[int, str], None]) -> Callable[[Progress], None]:
    """Progress of several fits, one after the other, as one count."""
    before, last = 0, 0

    def report(at: Progress) -> None:
        nonlocal before, last
        if at.step < last:
            before += last
        last = at.step
        show(before + at.step, f"loss {at.loss:.2e}  validation {at.validation:.2e}")

    return report


def announce(console: Console, problem: Problem, description: dict[str, Any]) -> None:
    """Says what is trained on what, and what was assumed."""
    data = problem.fitted
    trajectories = len(np.unique(data.trajectory))
    needs = problem.needs
    terms = " and ".join(name for name in ("gravity", "friction") if getattr(needs, name)) or "no potential"
    console.print(f"{problem.name}: {len(data.t)} samples of {trajectories} stretches for training and validation")
    console.print(f"{'-'.join(needs.joints)} with {terms}; {description['kind']}, f64")
    missing = [key for key in data.estimated if key != "tau"]
    if missing:
        console.print(f"not in the data: {', '.join(missing)}; finite differences start the fit to motions")
    if problem.name in (REAL, MEASURED) and np.array_equal(data.p if data.p is not None else 0, data.qd):
        console.print("momenta p are taken as qd, per unit of inertia")


def latency_of(folder: Path, problem: Problem) -> dict[str, float]:
    """Of one call of the rates, of the stored model as a user loads it."""
    field, truth = load_phase_field(folder), problem.truth[0]
    states = list(zip(truth.q[0, :256], truth.p[0, :256], strict=True))
    found = one_step(field.rates, states, calls=2000)
    return {"one_step_p50_us": found.p50_us, "one_step_p99_us": found.p99_us}


def draw(folder: Path, problem: Problem, kind: str, seen: Seen, history: list[Progress]) -> None:
    """Writes what there is to draw."""
    name = "baseline" if kind == KINDS["baseline"] else "hnn"
    write_figure(folder / "motions.png", figure_of(problem, {name: seen}))
    truth = problem.truth[0]
    stride = max(1, len(truth.t) // GIF_FRAMES)
    animations.write_motion_gif(folder / "motions.gif", {TRUTH: truth, name: seen.motions}, stride=stride)
    if len(history) > 1:
        best = min(history, key=lambda at: at.validation).step
        write_figure(folder / "training.png", figures.training_curve(history, best_step=best, error="error (weighted)"))


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
            table.add_row(name.replace("_", " "), f"{value:.4g}", UNITS.get(name, ""))
    return table
