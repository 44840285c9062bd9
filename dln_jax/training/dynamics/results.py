"""Evaluates a training of dynamics: test errors, speed, figures and tables."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.splits import merged
from dln_jax.figures.torques import force_decomposition, tip_paths
from dln_jax.figures.training import training_curve
from dln_jax.learning.engine.problem import Training
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.metrics.errors import as_arrays, errors, mean_square, samples_of
from dln_jax.metrics.latency import Latency, one_step
from dln_jax.metrics.motions import Motion, by_trajectory, metrics_of_motions, records_of
from dln_jax.metrics.verdict import Verdict
from dln_jax.precision import data_type
from dln_jax.runs.report import png
from dln_jax.training.dynamics.programs import Programs, judged_data
from dln_jax.training.dynamics.task import Task
from dln_jax.training.dynamics.verdict import judge_fit
from dln_jax.training.results import cost_metrics, number, unit_of
from dln_jax.training.uncertainty import uncertainty_metrics
from dln_jax.types import InputError
from dln_jax.zoo.run import load

SUMMARIES = {"median": np.median, "mean": np.mean, "standard_deviation": np.std, "largest": np.max}
"""Statistics over the seeds' test errors."""
CEILINGS = {
    "vpt_seconds": "vpt_ceiling_seconds",
    "vpt_interpolated_seconds": "vpt_ceiling_interpolated_seconds",
    "normalised_state_error": "normalised_state_error_ceiling",
    "energy_error_j": "energy_error_ceiling_j",
}
"""Rollout metrics and the names of the true plant's values."""
MEANINGS = {
    "torque_mse": "torque, mean square error",
    "test_nmse": "torque, error over variance, mean of joints",
    "validation_nmse": "the same, on validation motions",
    "zero_nmse": "the same, of a guess of zero",
    "noise_nmse": "the same, of the noise of the torques",
    "file_nmse": "the same, of the robot's file",
    "forward_mse": "acceleration, mean square error",
    "validation_error": "validation error, sum over joints",
    "power_mse": "power, mean square error",
    "inertial_mse": "inertial force, mean square error",
    "coriolis_mse": "Coriolis force, mean square error",
    "gravity_mse": "gravity force, mean square error",
    "gravity_determined": "gravity told from friction: 1 yes, 0 known only in sum",
    "smallest_mass_eigenvalue": "smallest eigenvalue of the mass matrix",
    "share_not_definite": "states where the mass matrix is not definite",
    "largest_condition_number": "largest condition number of the mass matrix",
    "verdict": "verdict: 0 good, 1 doubtful, 2 refused",
    "coverage_95_share": "torques within the 95 % band",
    "coverage_95_worst_joint_share": "the same, at the joint furthest from 95 %",
    "out_of_distribution_share": "states out of distribution",
    "by_torques_vpt_seconds": "valid prediction time of a start fitted to q, tree by torques",
    "by_motions_vpt_seconds": "the same, tree refined by motions",
    "vpt_seconds": "valid prediction time, torque held",
    "vpt_interpolated_seconds": "valid prediction time, torque interpolated",
    "rollout_seconds": "duration of a test motion",
    "normalised_state_error": "state error of a rollout, in standard deviations",
    "energy_error_j": "energy balance error of a rollout",
    "one_step_p50_us": "one call of the inverse model, median",
    "one_step_p99_us": "one call of the inverse model, 99 %",
}
"""Labels of metrics; other names are self-explanatory."""


class Evaluation(NamedTuple):
    """Results of a stored model of dynamics on the test."""

    metrics: dict[str, float | int]
    verdict: Verdict
    figures: dict[str, Callable[[Path], None]]


def evaluate(folder: Path, task: Task, training: Training, programs: Programs, *, seeds: int) -> Evaluation:
    """Loads the stored model as a user would and evaluates it on the test trajectories."""
    run = load(folder)
    functions, test = run.dynamics, task.sets.test
    latency = latency_of(functions, task)
    samples = samples_of(judged_data(task), data_type(task.precision))
    answers = as_arrays(programs.predict(run.parameters, samples))
    predicted = {name: array[: len(test.t)] for name, array in answers.items()}
    motions, of_rollouts = rollouts(run.parameters, task, programs)
    verdict, of_verdict = judge_fit(task, functions, answers, motions)
    spread = {}
    if seeds > 1:
        answers = [programs.predict(parameters_of(training, index), samples) for index in range(seeds)]
        of_seeds = [mean_square(np.asarray(answer["tau"], float)[: len(test.t)] - test.tau) for answer in answers]
        spread = {f"torque_mse_{name}": float(function(of_seeds)) for name, function in SUMMARIES.items()}
    of_bands, bands = uncertainty_metrics(folder, programs.double, test, predicted["tau"], task.kind)
    metrics = {
        **errors(predicted, test),
        "gravity_determined": int(not task.summed),
        **of_verdict,
        **({} if task.refinement is None else task.refinement.metrics),
        **spread,
        **of_bands,
        **of_rollouts,
        **validation_metrics(training, seeds, task.best),
        **cost_metrics(
            training,
            latency,
            parameters=sum(leaf.size for leaf in jax.tree.leaves(training.parameters)) // seeds,
            best_step=int(np.ravel(training.best_step)[best_seed(training, seeds, task.best)[1]]),
        ),
    }
    return Evaluation(metrics, verdict, {**figures_of(task, training, motions, predicted), **bands})


def best_seed(training: Training, seeds: int, best: int | None = None) -> tuple[Any, int]:
    """Parameters and index of the selected seed, by default the one with the lowest validation error."""
    if seeds == 1:
        return training.parameters, 0
    if best is None or not np.isfinite(training.validation[best]):
        best = int(np.argmin(np.nan_to_num(training.validation, nan=np.inf)))
    return parameters_of(training, best), best


def validation_metrics(training: Training, seeds: int, best: int | None) -> dict[str, float]:
    """Validation error of the model that is kept."""
    errors = np.ravel(training.validation)
    return {"validation_error": float(errors[best_seed(training, seeds, best)[1]])} if training.history else {}


def parameters_of(training: Training, index: int) -> Any:
    """Parameters of one of several seeds."""
    return jax.tree.map(lambda leaf: leaf[index], training.parameters)


def latency_of(functions: Dynamics | PlainDynamics, task: Task, *, calls: int = 5000) -> Latency:
    """Latency of one inverse-dynamics call."""
    test, dtype = task.sets.test, data_type(task.precision)
    arrays = (np.asarray(array[:512], dtype) for array in (test.q, test.qd, test.qdd))
    states = [tuple(map(jnp.asarray, state)) for state in zip(*arrays, strict=True)]  # rows of NumPy need no program
    return one_step(functions.inverse_dynamics, states, calls=calls)


def rollouts(parameters: Any, task: Task, programs: Programs) -> tuple[list[Motion], dict[str, float]]:
    """Test rollouts under interpolated torques, and prediction times with the true plant's; none for single states."""
    test = task.sets.test
    if len(np.unique(test.trajectory)) == len(test.t):
        return [], {}
    try:
        motions, energies = programs.follow(parameters, records_of(test, data_type(task.precision)))
        metrics = metrics_of_motions(motions, energies, test)
    except InputError as error:
        # The model is trained, so metrics that the test cannot provide are left out instead of refused.
        print(f"no rollouts: {error}")
        return [], {}
    plant = programs.ceilings()
    ceilings = {ceiling: plant[key] for key, ceiling in CEILINGS.items() if key in plant}
    return by_trajectory(motions, test)["interpolated"], {**metrics, **ceilings}


def figures_of(
    task: Task, training: Training, motions: list[Motion], predicted: dict[str, np.ndarray]
) -> dict[str, Callable[[Path], None]]:
    """The applicable figures; `motions` are the model's rollouts of the test, possibly none."""
    test = task.sets.test
    note = " (gravity in sum with friction)" if task.summed else ""
    figures = {"decomposition.png": png(force_decomposition, test, predicted, model=task.kind, note=note)}
    if training.history and task.solver is not None:
        torque = task.objective.selects_by == "torque"
        units = {} if torque else {"error": "loss (normalised)", "unit": "loss, in units of the data's spread"}
        best = int(np.max(training.best_step))
        figures["training.png"] = png(training_curve, training.history, best_step=best, **units)
    if task.scene is not None and task.scene.tip is not None:
        options = {"test": test, "motions": motions, "model": task.kind}
        figures["tip_paths.png"] = png(tip_paths, merged(task.sets), task.scene.tip, **options)
    return figures


def columns(metrics: dict[str, float | int]) -> tuple[str, ...]:
    """Columns of the printed table, with one for the true plant if it is known."""
    known = any(ceiling in metrics for ceiling in CEILINGS.values())
    return ("quantity", "value", *["true plant"] * known, "unit")


def rows(metrics: dict[str, float | int], task: Task) -> list[tuple[str, ...]]:
    """Rows of the printed table; rollout metrics also show the true plant's values."""
    force = "N m" if set(task.needs.joints) == {"revolute"} else "N m or N"
    units = dict.fromkeys((key for key in metrics if "_mse" in key), f"({force})²")
    units |= {key: "1" for key in metrics if key.endswith("_nmse")}
    units |= {"power_mse": "W²", "forward_mse": "(1/s²)²", "energy_error_j": "J", "normalised_state_error": "1"}
    units["validation_error"] = f"({force})²" if task.objective.selects_by == "torque" else "1"
    known = len(columns(metrics)) == 4
    lines = []
    for key, value in metrics.items():
        if key not in CEILINGS.values() and key != "verdict":
            ceiling = metrics.get(CEILINGS.get(key, ""))
            beside = ["" if ceiling is None else number(key, ceiling)] * known
            lines.append((MEANINGS.get(key, key.replace("_", " ")), number(key, value), *beside, unit_of(key, units)))
    calls = f"{1e6 / metrics['one_step_p50_us']:,.0f}"
    lines.append(("calls of the inverse model", calls, *[""] * known, "1/s"))
    return lines
