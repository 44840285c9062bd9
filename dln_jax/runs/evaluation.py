"""Evaluates a fit of dynamics on its test: errors, rollouts, speed, uncertainty, verdict, table and figures."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from dln_jax.data.log import Log, Parts
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import merged
from dln_jax.figures.torques import force_decomposition, tip_paths, torque_bands
from dln_jax.figures.training import training_curve
from dln_jax.learning.engine.optimisers import Adam
from dln_jax.learning.fit import Fit, double
from dln_jax.learning.linear import design, design_chunks
from dln_jax.learning.objectives import SCALED_TORQUE, torque_scale
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.errors import LEVEL, as_arrays, coverage, errors, mean_square, prediction_program, samples_of
from dln_jax.metrics.latency import latency_of
from dln_jax.metrics.motions import Motion, by_trajectory, metrics_of_motions, motion_program, records_of
from dln_jax.models.model import Model
from dln_jax.models.uncertainty import Uncertainty, deviation_of_rows, exceeds, scores_of_rows
from dln_jax.precision import compiled
from dln_jax.runs.report import Report, cost_metrics, png, rows_of
from dln_jax.runs.verdict import verdict_of
from dln_jax.types import InputError

SUMMARIES = {"median": np.median, "mean": np.mean, "standard_deviation": np.std, "largest": np.max}
"""Statistics over the seeds' test errors."""
CEILINGS = {
    "vpt_seconds": "vpt_ceiling_seconds",
    "vpt_interpolated_seconds": "vpt_ceiling_interpolated_seconds",
    "normalised_state_error": "normalised_state_error_ceiling",
    "energy_error_j": "energy_error_ceiling_j",
}
"""Rollout metrics and the names of the true plant's values."""
LABELS = {
    "forward_mse": "acceleration MSE",
    "inertial_mse": "inertial force MSE",
    "coriolis_mse": "Coriolis force MSE",
    "gravity_mse": "gravity force MSE",
    "gravity_determined": "gravity is determined (1: yes)",
    "test_nmse": "torque nMSE (MSE over variance)",
    "validation_nmse": "nMSE on validation motions",
    "zero_nmse": "nMSE of predicting zero",
    "noise_nmse": "nMSE of the torque noise (floor)",
    "file_nmse": "nMSE of the robot's file",
    "smallest_mass_eigenvalue": "smallest eigenvalue, mass matrix",
    "share_not_definite": "states with an indefinite mass matrix",
    "largest_condition_number": "largest condition number, mass matrix",
    "coverage_95_share": "coverage of the 95 % band",
    "coverage_95_worst_joint_share": "coverage of the worst joint",
    "out_of_distribution_share": "share of states out of distribution",
    "vpt_seconds": "valid prediction time, torque held",
    "vpt_interpolated_seconds": "valid prediction time, interpolated",
    "rollout_seconds": "length of a test motion",
    "normalised_state_error": "normalised state error of a rollout",
    "energy_error_j": "energy balance error of a rollout",
    "descents_agreeing": "starts that reached the lowest loss",
    "descents": "starts of the search",
    "twin_degrees": "angle between axes of the best starts, degrees",
    "twin_metres": "distance between axes of the best starts, m",
    "twin_error": "ratio of the errors of the best starts",
    "error_over_noise": "MSE over the noise variance",
}
"""Labels of metrics whose names do not explain themselves."""
UNITS = {
    "nmse": "1",
    "power_mse": "W²",
    "energy_error_j": "J",
}
"""Units of metrics other than times and errors of forces."""
CHUNK = 256
"""Number of samples per call of the program that linearises the torques in the parameters."""


def evaluate(
    fit: Fit, parts: Parts, log: Log, *, mesh: Mesh | None = None, say: Callable[[str], None] = print
) -> Report:
    """Evaluates a fit on the test of its parts.

    Args:
        fit: the fit.
        parts: the parts of the log that it was fitted to.
        log: the log; its plant, if known, bounds what rollouts can reach.
        mesh: devices that share the samples.
        say: takes lines on what the test cannot provide.
    """
    test, training = parts.sets.test, fit.training
    # The test samples are followed by the validation samples, so that one program predicts both.
    both = (samples_of(part, fit.dtype) for part in (test, parts.sets.validation))
    samples = jax.tree.map(lambda *arrays: np.concatenate(arrays), *both)
    predict = compiled(prediction_program(fit.model.energies, mesh=mesh))
    answers = as_arrays(predict(fit.parameters, samples))
    predicted = {name: array[: len(test.t)] for name, array in answers.items()}
    motions, of_rollouts = rollouts(fit, test, log, say)
    verdict, of_verdict = verdict_of(fit, parts, log, answers, motions)
    spread, seeds = {}, np.size(fit.seeds)
    if seeds > 1:
        of_seeds = [predict(fit.of_seed(index), samples)["tau"] for index in range(seeds)]
        errors_of_seeds = [mean_square(np.asarray(tau, float)[: len(test.t)] - test.tau) for tau in of_seeds]
        spread = {f"torque_mse_{name}": float(function(errors_of_seeds)) for name, function in SUMMARIES.items()}
    summed = fit.summed(parts)
    figures = figures_of(fit, parts, log, motions, predicted, summed)
    of_bands, of_figures = bands_of(fit, test, predicted["tau"])
    figures |= of_figures
    metrics = {
        **errors(predicted, test),
        "gravity_determined": int(not summed),
        **of_verdict,
        **spread,
        **of_bands,
        **of_rollouts,
        **({"validation_error": float(np.ravel(training.validation)[fit.best])} if training.history else {}),
        **cost_metrics(
            training,
            latency_of(fit, test),
            parameters=sum(np.size(leaf) for leaf in jax.tree.leaves(fit.parameters)),
            best_step=int(np.ravel(training.best_step)[fit.best]),
        ),
    }
    columns, rows = table_of(metrics, fit)
    return Report(
        metrics=metrics,
        rows=rows,
        title=f"test on {log.name}, {fit.description['precision']}",
        columns=columns,
        verdict=verdict,
        figures=figures,
        chosen=choices_of(fit, parts, log),
        lines=tuple(lines_on(fit, summed)),
        error=failure(fit),
    )


def rollouts(
    fit: Fit, test: Trajectories, log: Log, say: Callable[[str], None]
) -> tuple[list[Motion], dict[str, float]]:
    """Test rollouts under interpolated torques, and prediction times with the true plant's; none for single states."""
    if len(np.unique(test.trajectory)) == len(test.t):
        return [], {}
    try:
        follow = compiled(motion_program(lambda parameters: dynamics(fit.model.energies(parameters))))
        motions, energies = follow(fit.parameters, records_of(test, fit.dtype))
        metrics = metrics_of_motions(motions, energies, test)
    except InputError as error:
        # The model is trained, so metrics that the test cannot provide are left out instead of refused.
        say(f"no rollouts: {error}")
        return [], {}
    if log.plant is not None:
        plant = dynamics(log.plant)
        true, energies = compiled(motion_program(lambda _: plant))(None, records_of(test, None))
        best = metrics_of_motions(true, energies, test)
        metrics |= {ceiling: best[key] for key, ceiling in CEILINGS.items() if key in best}
    return by_trajectory(motions, test)["interpolated"], metrics


def bands_of(
    fit: Fit, test: Trajectories, predicted: np.ndarray
) -> tuple[dict[str, float], dict[str, Callable[[Path], None]]]:
    """Coverage of the 95 % bands on test torques, share of test states out of distribution, and their figure.

    Empty for a fit without uncertainty.

    Args:
        predicted: the model's torques on the test data [N, d].
    """
    if fit.uncertainty is None:
        return {}, {}
    std, out_of_distribution = bands(double(fit), fit.parameters, fit.uncertainty, test)
    shares = coverage(predicted - test.tau, std, levels=(LEVEL,))[0]
    metrics = {
        "coverage_95_share": float(shares.mean()),
        "coverage_95_worst_joint_share": float(shares[np.argmax(abs(shares - LEVEL))]),
        "out_of_distribution_share": float(out_of_distribution.mean()),
    }
    names = () if test.joint_names is None else test.joint_names
    figure = png(torque_bands, test, predicted, (std, out_of_distribution), model=fit.name, names=names)
    return metrics, {"uncertainty.png": figure}


def bands(model: Model, parameters: Any, uncertainty: Uncertainty, data: Trajectories) -> tuple[np.ndarray, np.ndarray]:
    """Deviations of the torques [N, d] and out-of-distribution flags [N], by the program that the estimate compiled.

    Args:
        model: the model in float64.
    """
    answers, first = [], 0
    with jax.enable_x64(True):
        parameters = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), parameters)
        for rows, *_ in design_chunks(design(model), parameters, data, CHUNK, even=False):
            part = slice(first, first + len(rows))
            answers.append(_bands(uncertainty, rows, (data.q[part], data.qd[part], data.qdd[part])))
            first = part.stop
    std, flags = map(np.concatenate, zip(*answers, strict=True))
    return std, flags


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0))
def _bands(uncertainty: Uncertainty, rows: Any, state: tuple[Any, ...]) -> tuple[Any, Any]:
    std = deviation_of_rows(rows, uncertainty.factor, uncertainty.noise, uncertainty.inflation)
    return std, exceeds(scores_of_rows(rows, state, uncertainty))


def figures_of(
    fit: Fit, parts: Parts, log: Log, motions: list[Motion], predicted: dict[str, np.ndarray], summed: list[int]
) -> dict[str, Callable[[Path], None]]:
    """The applicable figures; `motions` are the model's rollouts of the test, possibly none.

    `summed` are the joints whose gravity and friction are known only in sum.
    """
    test, training = parts.sets.test, fit.training
    note = " (gravity in sum with friction)" if summed else ""
    name = fit.name
    figures = {"decomposition.png": png(force_decomposition, test, predicted, model=name, note=note)}
    if training.history and fit.optimiser is not None:
        torque = fit.objective.selects_by == "torque"
        units = {} if torque else {"error": "loss (normalised)", "unit": "loss, in units of the data's spread"}
        best = np.max(training.best_step)
        figures["training.png"] = png(training_curve, training.history, best_step=best, **units)
    if log.tip is not None:
        figures["tip_paths.png"] = png(tip_paths, merged(parts.sets), log.tip, test=test, motions=motions, model=name)
    return figures


def table_of(metrics: dict[str, float | int], fit: Fit) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Columns and rows of the printed table; rollout metrics also show the true plant's values, if it is known."""
    force = "(N m)²" if set(fit.needs.joints) == {"revolute"} else "(N m or N)²"
    own = {name: value for name, value in metrics.items() if name not in (*CEILINGS.values(), "verdict")}
    acceleration = force.replace("N m", "rad/s²").replace("N", "m/s²")
    units = {**UNITS, "forward_mse": acceleration, "mse": force}
    units["validation_error"] = force if fit.objective.selects_by == "torque" else "1"
    true = [metrics.get(CEILINGS.get(name, "")) for name in own]
    known = any(number is not None for number in true)
    rows = [
        (label, shown, *["" if number is None else f"{number:.4g}"] * known, unit)
        for (label, shown, unit), number in zip(rows_of(own, LABELS, units), true, strict=True)
    ]
    return ("quantity", "value", *["true plant"] * known, "unit"), rows


def choices_of(fit: Fit, parts: Parts, log: Log) -> dict[str, Any]:
    """Values that the fit chose, for config.json."""
    chosen = dict(fit.description)
    if fit.optimiser is not None:
        chosen |= {
            "optimizer": "adam" if isinstance(fit.optimiser, Adam) else "gauss-newton",
            **fit.optimiser._asdict(),
        }
    if log.smoothed is not None:
        chosen["cutoff_hz"] = log.smoothed.cutoff
    if fit.objective is SCALED_TORQUE:
        chosen["validation_units"] = torque_scale(parts.sets.train).tolist()
    return chosen | {"seeds": fit.seeds}


def lines_on(fit: Fit, summed: list[int]) -> Iterator[str]:
    """Lines that name the selected seed, forces known only in sum, and the reason of an early end."""
    if not isinstance(fit.seeds, int):
        by = "cross-validation" if fit.cross_validated else "validation"
        yield f"the run keeps seed {fit.seeds[fit.best]}, the best by {by}"
    if summed:
        yield f"gravity and friction of joints {summed} are known only as a sum; constants count as potential"
    stop = fit.training.stop
    if stop.reason == "no improvement":
        yield f"stopped early, at step {stop.step}: the validation error no longer improved"
    if stop.reason == "time":
        yield f"time is up at step {stop.step}; the best parameters so far are kept, and --resume continues"


def failure(fit: Fit) -> str:
    """Why the training failed; empty if it did not."""
    if fit.training.stop.reason != "not finite":
        return ""
    remedy = "lower --learning-rate or use --precision f64" if isinstance(fit.optimiser, Adam) else "check the data"
    step = fit.training.stop.step
    return f"the loss stopped being finite after step {step}; the last good model is kept; {remedy}"
