"""Identifies a robot into a run folder: parameters and their uncertainty, held-out errors, and the robot's file."""

import time
from pathlib import Path

import numpy as np

from dln_jax.cli.running import command_folder
from dln_jax.cli.stored_arguments import write_config
from dln_jax.data.robot_files import write_robot
from dln_jax.figures.friction import friction_curves
from dln_jax.figures.torques import torque_by_joint
from dln_jax.files import write_bytes, write_figure, write_json
from dln_jax.identification.consistent import is_consistent
from dln_jax.identification.identify import Identification, identify, parameters_of
from dln_jax.identification.report import base_rows, findings, parameter_rows, summary, text
from dln_jax.metrics.errors import normalised_error
from dln_jax.metrics.verdict import FitRefused, Verdict
from dln_jax.training.identification.additions import (
    ADDED,
    Predict,
    Predictions,
    add_residual,
    judge_residual,
    predictor,
    residual_lines,
    shape_lines,
    store_uncertainty,
    stored_description,
)
from dln_jax.training.identification.task import Case, Options, prepare, with_shapes
from dln_jax.training.identification.verdict import judged
from dln_jax.training.results import print_numbers
from dln_jax.types import InputError
from dln_jax.zoo.run import save

KEPT = "identified"
"""Key of the parameters that are kept; the other keys are the file and least squares."""


def run(given: Options, command: str) -> None:
    """Identifies a robot and writes the run folder, by default runs/`command`-1, -2, ...

    Raises:
        InputError: a file or an option is wrong; nothing is kept.
        FitRefused: the robot must not be used; the run folder is complete except for the robot's file.
    """
    case = prepare(given)
    with command_folder(given, command) as folder:
        announce(given, case)
        began = time.perf_counter()
        case = with_shapes(given.velocity_scale, case)
        found = identify(
            case.model,
            case.known,
            case.sets.train,
            joints=case.robot.tree.joints,
            noise=case.noise,
            robust=given.robust,
            consistent=given.consistent,
            regularisation=given.regularisation,
        )
        kept = parameters_of(found.theta, case.known)
        added = add_residual(case, kept) if given.residual else None
        seconds = time.perf_counter() - began
        description = stored_description(case, added)
        save(folder, description, kept if added is None else added.parameters)
        predict = predictor(case.model)
        metrics, predicted = evaluate(case, found, predict)
        if added is not None and added.settings:
            predicted[ADDED] = judge_residual(case, added, metrics)
        kept_torques = ADDED if ADDED in predicted else KEPT
        torques = {name: each.torque for name, each in predicted.items()}
        verdict, of_verdict = judged(case, found, predict, torques, kept_torques, robust=given.robust)
        metrics |= of_verdict
        if given.uncertainty:
            metrics |= store_uncertainty(folder, case, found, added, figures=given.figures)
        write_json(folder / "metrics.json", {**metrics, "identify_seconds": seconds})
        write_json(folder / "parameters.json", {"base": base_rows(found), "parameters": parameter_rows(found)})
        write_bytes(folder / "report.txt", text(found).encode())
        if given.figures:
            draw(folder, case, found, predict, predicted[KEPT])
        lines = [*findings(found, case.sets.train, case.names), *write_file(folder, given, case, found, verdict)]
        write_config(folder, given, **description, verdict=verdict._asdict())
        print_result(case, found, predicted)
        print(*summary(found), *shape_lines(case), *residual_lines(added), *lines, sep="\n")
        print(verdict.line)
        print(f"run folder: {folder} (every parameter: report.txt)")
        if verdict.level == "refused":
            raise FitRefused(verdict)


def announce(given: Options, case: Case) -> None:
    """Prints the robot, the data and the assumptions made."""
    train, test, blocks = case.sets
    print(f"{given.robot.name}: {len(case.names)} joints, {', '.join(case.names)}")
    held = "blocks of time of the one trajectory" if blocks else "trajectories"
    print(f"{given.data.name}: {len(train.t)} samples fitted, {len(test.t)} held out ({held})")
    if train.joint_names is None:
        print("the data name no joints: taken to be in this order (key joint_names)")
    for line in case.said:
        print(line)
    if case.held:
        print(f"held still: {', '.join(case.held)}")


def evaluate(
    case: Case, found: Identification, predict: Predict
) -> tuple[dict[str, float | int], dict[str, Predictions]]:
    """Metrics on held-out data, and predictions by the file, by least squares, and by the parameters kept."""
    test = case.sets.test
    sources = {"file": found.known, "least_squares": found.fit.theta, KEPT: found.theta}
    predicted = {
        name: predict(parameters_of(theta, case.known), test.q, test.qd, test.qdd) for name, theta in sources.items()
    }
    metrics: dict[str, float | int] = {
        "parameters": len(found.theta),
        "base_parameters": len(found.base.words),
        "rank": found.fit.rank,
        "condition": found.fit.condition,
    }
    for name, each in predicted.items():
        errors = normalised_error(each.torque, test.tau)
        prefix = "" if name == KEPT else f"{name}_"
        metrics[f"{prefix}torque_mse"] = float(np.mean(np.sum((each.torque - test.tau) ** 2, axis=1)))
        metrics[f"{prefix}nmse"] = float(np.nanmean(errors))
        metrics |= {f"{prefix}nmse_joint_{k + 1}": float(value) for k, value in enumerate(errors)}
    metrics |= {f"noise_joint_{k + 1}": float(value) for k, value in enumerate(found.fit.noise)}
    if found.consistent is not None:
        metrics |= {"consistent_iterations": found.consistent.iterations}
    return metrics, predicted


def draw(folder: Path, case: Case, found: Identification, predict: Predict, kept: Predictions) -> None:
    """Writes the figures."""
    test, names, units = case.sets.test, case.names, units_of(case)
    write_figure(folder / "torque.png", torque_by_joint(test, kept.torque, names, units))
    if case.laws:
        # All joints at once, each over its own range: friction in a joint does not depend on the others.
        rates = np.linspace(test.qd.min(axis=0), test.qd.max(axis=0), len(test.t))
        still = np.zeros_like(rates)
        curves = predict(parameters_of(found.theta, case.known), still, rates, still).friction
        left = test.tau - (kept.torque - kept.friction)
        figure = friction_curves(
            {"identified": (rates, curves)}, names=names, measured=(test.qd, left),
            rate_unit=["rad/s" if unit == "N m" else "m/s" for unit in units], force_unit=units,
        )  # fmt: skip
        write_figure(folder / "friction.png", figure)


def write_file(folder: Path, given: Options, case: Case, found: Identification, verdict: Verdict) -> list[str]:
    """Writes the robot's file with the parameters kept; returns a line on what it lacks, or why there is none."""
    bodies = is_consistent(found.theta, found.columns)
    path = folder / f"{given.robot.stem}_identified{given.robot.suffix}"
    if verdict.level == "refused":
        return [f"no {path.name}: the fit is refused"]
    if not all(bodies):
        which = ", ".join(name for name, good in zip(case.names, bodies, strict=True) if not good)
        return [f"no {path.name}: the least-squares links behind {which} are not physically consistent"]
    parameters = parameters_of(found.theta, case.known)
    tree = case.robot.tree._replace(inertias=np.asarray(parameters.inertias), armature=np.asarray(parameters.armature))
    remarks = [f"Identified from {given.data.name}."]
    coefficients = {
        name: np.asarray(values)
        for name, values in parameters._asdict().items()
        if values is not None and name not in ("inertias", "armature")
    }
    friction = {"damping": coefficients.pop("viscous", None), "coulomb": coefficients.pop("coulomb", None)}
    for name, values in coefficients.items():
        pairs = ", ".join(f"{joint} {value!r}" for joint, value in zip(case.names, values.tolist(), strict=True))
        remarks.append(f"Of friction, for which there is no place, {name}: {pairs}.")
    try:
        write_robot(path, given.robot, tree, **friction, lock=case.held, remarks=tuple(remarks))
    except InputError as error:
        return [f"no {path.name}: {error}"]
    lacks = " without armature, for which URDF has no place (a comment in it states it)" * (path.suffix == ".urdf")
    return [f"{path.name}: the robot's file with these values{lacks}"]


def units_of(case: Case) -> list[str]:
    """Units of the joints' forces."""
    return ["N m" if kind == "revolute" else "N" for kind in case.robot.tree.joints]


def print_result(case: Case, found: Identification, predicted: dict[str, Predictions]) -> None:
    """Prints the held-out errors of every joint."""
    tau = case.sets.test.tau
    errors = {name: normalised_error(each.torque, tau) for name, each in predicted.items()}
    rms = np.sqrt(np.mean((predicted[KEPT].torque - tau) ** 2, axis=0))
    rows = [
        (name, *(f"{each[k]:.3g}" for each in errors.values()), f"{rms[k]:.3g}", f"{found.fit.noise[k]:.3g}", unit)
        for k, (name, unit) in enumerate(zip(case.names, units_of(case), strict=True))
    ]
    rows.append(("mean", *(f"{np.nanmean(each):.3g}" for each in errors.values()), "", "", ""))
    columns = ("joint", *(name.replace("_", " ") for name in errors), "rms", "noise", "unit")
    print_numbers(rows, title="held out: nMSE by parameters, rms error, and noise of the fit", columns=columns)
