"""Identifies a robot, as a kind of the pipeline: parameters, their uncertainty, held-out errors, the robot's file."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jax.sharding import Mesh

from dln_jax.data.robot_files import write_robot
from dln_jax.figures.torques import friction_curves, torque_by_joint
from dln_jax.files import write_bytes, write_json
from dln_jax.identification.consistent import is_consistent
from dln_jax.identification.identify import Identification, identify, parameters_of
from dln_jax.identification.motions import MotionFit
from dln_jax.identification.report import base_rows, findings, parameter_rows, summary, text
from dln_jax.identification.residual import ResidualFit
from dln_jax.mechanics.trees.motors import armature_matrix
from dln_jax.metrics.errors import normalised_error
from dln_jax.metrics.verdict import Verdict
from dln_jax.models.trees import pairs_of
from dln_jax.runs.report import Report, png
from dln_jax.training.identification.additions import (
    ADDED,
    Predict,
    Predictions,
    add_residual,
    judge_residual,
    predictor,
    residual_lines,
    shape_lines,
    store_bands,
    stored_description,
)
from dln_jax.training.identification.motions import Chosen, fit_by, motion_lines, prediction_metrics
from dln_jax.training.identification.options import Options
from dln_jax.training.identification.task import Case, prepare, referred, with_terms
from dln_jax.training.identification.verdict import judged
from dln_jax.training.pipeline import Fitted, Kind
from dln_jax.training.uncertainty import uncertainty_metrics
from dln_jax.types import InputError

KEPT = "identified"
"""Key of the parameters that are kept; the other keys are the file and least squares."""


class Outcome(NamedTuple):
    """An identified robot."""

    case: Case
    """The robot and its data, with the fitted shapes of friction."""
    solution: Identification
    residual: ResidualFit | None
    seconds: float
    motions: MotionFit | None
    """Fit to motions, if requested and chosen; its parameters are those of `solution`."""
    choice: Chosen | None
    by_torques: np.ndarray
    """Parameters of the fit of torques alone."""


def announce(case: Case) -> Iterator[str]:
    """Lines on the robot, the data and the assumptions made."""
    train, test, blocks = case.sets
    yield f"{case.robot_file}: {len(case.names)} joints, {', '.join(case.names)}"
    kind = "blocks of time of the one trajectory" if blocks else "trajectories or parts of them"
    yield f"{case.data_file}: {len(train.t)} samples fitted, {len(test.t)} held out ({kind})"
    if train.joint_names is None:
        yield "the data name no joints: taken to be in this order (key joint_names)"
    yield from case.lines
    if case.locked:
        yield f"locked: {', '.join(case.locked)}"


def fit(case: Case, options: Options, folder: Path, mesh: Mesh | None) -> Fitted:
    """Fits shapes of friction, the linear parameters, and a residual network if one is asked for."""
    began = time.perf_counter()
    measured, friction = with_terms(options.velocity_scale, case)
    at = None if friction is None or "load" not in measured.laws else friction.parameters
    case = measured if friction is None else referred(measured, friction.parameters)
    settings = {
        "joints": case.robot.tree.joints, "at": at, "noise": case.noise, "robust": options.robust,
        "consistent": options.consistent, "regularisation": options.regularisation,
    }  # fmt: skip
    solution = identify(case.model, case.known, case.sets.train, **settings)
    by_torques, motions, choice = solution.theta, None, None
    if case.motions is not None:
        solution, motions, choice = fit_by(
            options.by, case.model, case.known, solution, case.sets.train, case.motions, options.window, **settings
        )
    kept = parameters_of(solution.theta, case.known)
    case = referred(measured, kept)
    residual = add_residual(case, kept) if options.residual else None
    seconds = time.perf_counter() - began
    parameters = kept if residual is None else residual.parameters
    return Fitted(
        stored_description(case, residual),
        parameters,
        Outcome(case, solution, residual, seconds, motions, choice, by_torques),
    )


def judge(case: Case, fitted: Fitted, options: Options, folder: Path) -> Report:
    """Held-out errors, uncertainty and verdict; writes parameters, the report and the robot's file."""
    case, solution, residual, seconds, motions, choice, by_torques = fitted.outcome
    predict = predictor(case.model)
    metrics, predicted = evaluate(case, solution, predict)
    if residual is not None and residual.settings:
        predicted[ADDED] = judge_residual(case, residual, metrics)
    of_motions, moves = [], False
    if choice is not None and case.motions is not None:
        numbers = prediction_metrics(case.model, case.known, case.motions, by_torques, solution.theta, motions)
        of_motions, metrics = motion_lines(options.by, motions, choice, numbers), metrics | numbers
        moves = motions is not None and np.isclose(numbers["vpt_seconds"], numbers["predicted_seconds"])
    kept = ADDED if ADDED in predicted else KEPT
    torques = {name: prediction.torque for name, prediction in predicted.items()}
    verdict, of_verdict = judged(case, solution, predict, torques, kept, robust=options.robust, moves=bool(moves))
    metrics |= of_verdict
    figures = figures_of(case, solution, predict, predicted[KEPT]) if options.figures else {}
    if options.uncertainty:
        model = store_bands(folder, case, solution, residual)
        of_bands, bands = uncertainty_metrics(folder, model, case.sets.test, torques[kept], case.description["name"])
        metrics |= of_bands
        figures |= bands
    write_json(folder / "parameters.json", {"base": base_rows(solution), "parameters": parameter_rows(solution)})
    write_bytes(folder / "report.txt", text(solution).encode())
    lines = [*case.lines, *findings(solution, case.sets.train, case.names)]
    lines += write_file(folder, options, case, solution, verdict)
    return Report(
        metrics={**metrics, "identify_seconds": seconds},
        rows=rows(case, solution, predicted),
        title="held out: nMSE by parameters, rms error, and noise of the fit",
        columns=("joint", *(name.replace("_", " ") for name in predicted), "rms", "noise", "unit"),
        verdict=verdict,
        figures=figures,
        chosen=fitted.description,
        lines=(
            *of_motions, *summary(solution), *shape_lines(case), *residual_lines(residual), *lines,
            "every parameter: report.txt",
        ),
    )  # fmt: skip


def evaluate(
    case: Case, solution: Identification, predict: Predict
) -> tuple[dict[str, float | int], dict[str, Predictions]]:
    """Metrics on held-out data, and predictions by the file, by least squares, and by the parameters kept."""
    test = case.sets.test
    sources = {"file": solution.known, "least_squares": solution.fit.theta, KEPT: solution.theta}
    predicted = {
        name: predict(parameters_of(theta, case.known), test.q, test.qd, test.qdd) for name, theta in sources.items()
    }
    metrics: dict[str, float | int] = {
        "parameters": len(solution.theta),
        "base_parameters": len(solution.base.words),
        "rank": solution.fit.rank,
        "condition": solution.fit.condition,
    }
    for name, prediction in predicted.items():
        errors = normalised_error(prediction.torque, test.tau)
        prefix = "" if name == KEPT else f"{name}_"
        metrics[f"{prefix}torque_mse"] = float(np.mean(np.sum((prediction.torque - test.tau) ** 2, axis=1)))
        metrics[f"{prefix}nmse"] = float(np.nanmean(errors))
        metrics |= {f"{prefix}nmse_joint_{k + 1}": float(value) for k, value in enumerate(errors)}
    metrics |= {f"noise_joint_{k + 1}": float(value) for k, value in enumerate(solution.fit.noise)}
    if solution.consistent is not None:
        metrics |= {"consistent_iterations": solution.consistent.iterations}
    return metrics, predicted


def figures_of(
    case: Case, solution: Identification, predict: Predict, kept: Predictions
) -> dict[str, Callable[[Path], None]]:
    """The applicable figures, by file name."""
    test, names, units = case.sets.test, case.names, units_of(case)
    figures = {"torque.png": png(torque_by_joint, test, kept.torque, names, units)}
    if case.laws:
        # All joints at once, each over its own range: friction in a joint does not depend on the others.
        rates = np.linspace(test.qd.min(axis=0), test.qd.max(axis=0), len(test.t))
        still = np.zeros_like(rates)
        curves = predict(parameters_of(solution.theta, case.known), still, rates, still).friction
        left = test.tau - (kept.torque - kept.friction)
        options: dict[str, Any] = {"names": names, "measured": (test.qd, left), "force_unit": units}
        options["rate_unit"] = ["rad/s" if unit == "N m" else "m/s" for unit in units]
        figures["friction.png"] = png(friction_curves, {"identified": (rates, curves)}, **options)
    return figures


def write_file(folder: Path, options: Options, case: Case, solution: Identification, verdict: Verdict) -> list[str]:
    """Writes the robot's file with the parameters kept; returns lines on missing parts, or why no file was written."""
    bodies = is_consistent(solution.theta, solution.columns)
    path = folder / f"{options.robot.stem}_identified{options.robot.suffix}"
    if verdict.level == "refused":
        return [f"no {path.name}: the fit is refused"]
    if not all(bodies):
        which = ", ".join(name for name, good in zip(case.names, bodies, strict=True) if not good)
        return [f"no {path.name}: the least-squares links behind {which} are not physically consistent"]
    parameters = parameters_of(solution.theta, case.known)
    motors = case.description["motors"]
    armature = armature_matrix(parameters.armature, motors, pairs_of(parameters.coupling))
    tree = case.robot.tree._replace(inertias=np.asarray(parameters.inertias), armature=np.asarray(armature))
    remarks = [f"Identified from {options.data.name}."]
    coefficients = {
        name: np.asarray(values)
        for name, values in parameters._asdict().items()
        if values is not None and name not in ("inertias", "armature", "coupling")
    }
    friction = {"damping": coefficients.pop("viscous", None), "coulomb": coefficients.pop("coulomb", None)}
    for name, values in coefficients.items():
        pairs = ", ".join(f"{joint} {value!r}" for joint, value in zip(case.names, values.tolist(), strict=True))
        remarks.append(f"Friction that the file cannot state, {name}: {pairs}.")
    remarks += [f"Not in this file: {line}." for line in shape_lines(case) if line.startswith(("load", "cooling"))]
    try:
        write_robot(path, options.robot, tree, **friction, motors=motors, lock=case.locked, remarks=tuple(remarks))
    except InputError as error:
        return [f"no {path.name}: {error}"]
    lacks = " without armature, which URDF cannot state (a comment in the file has it)" * (path.suffix == ".urdf")
    return [f"{path.name}: the robot's file with these values{lacks}"]


def units_of(case: Case) -> list[str]:
    """Units of the joints' forces."""
    return ["N m" if kind == "revolute" else "N" for kind in case.robot.tree.joints]


def rows(case: Case, solution: Identification, predicted: dict[str, Predictions]) -> list[tuple[str, ...]]:
    """Held-out errors of every joint."""
    tau = case.sets.test.tau
    errors = {name: normalised_error(prediction.torque, tau) for name, prediction in predicted.items()}
    rms = np.sqrt(np.mean((predicted[KEPT].torque - tau) ** 2, axis=0))
    lines = [
        (name, *(f"{error[k]:.3g}" for error in errors.values()), f"{rms[k]:.3g}", f"{solution.fit.noise[k]:.3g}", unit)
        for k, (name, unit) in enumerate(zip(case.names, units_of(case), strict=True))
    ]
    return [*lines, ("mean", *(f"{np.nanmean(error):.3g}" for error in errors.values()), "", "", "")]


IDENTIFICATION = Kind(prepare, announce, fit, judge)
