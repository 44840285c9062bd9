"""Identifies a robot: reads its log, fits, judges on held-out motions, and writes the run folder."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

import jax
import numpy as np
from jax import Array

from dln_jax.commands.identification.motions import (
    choose_window,
    lightly_filtered,
    motion_lines,
    prediction_times,
    refit,
    spread_of,
)
from dln_jax.commands.identification.verdict import Predict, judge_robot
from dln_jax.commands.identify import LAWS, NO_FRICTION, TEMPERATURE, Arguments
from dln_jax.data.log import SPLIT, Parts, read_log, split_log
from dln_jax.data.robot_files import write_robot
from dln_jax.data.robots import Robot, read_robot
from dln_jax.data.splits import Split, is_cut
from dln_jax.figures.torques import friction_curves, torque_bands
from dln_jax.files import write_bytes, write_json
from dln_jax.identification.identify import base_rows, findings, identify, parameter_rows, summary, text
from dln_jax.identification.residual import inner_split
from dln_jax.identification.rigid_tree import at_reference, build_rigid_tree, describe_rigid_tree
from dln_jax.learning.fit import Fit, with_uncertainty
from dln_jax.learning.friction import reference_temperature
from dln_jax.learning.linear import parameters_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import require_laws, shape_of
from dln_jax.mechanics.trees.motors import Pair, armature_matrix, require_motors
from dln_jax.metrics.errors import mean_square, normalised_error
from dln_jax.models.model import Model, Parameters
from dln_jax.models.trees import RigidTreeParameters, Rows, pairs_of
from dln_jax.precision import compiled
from dln_jax.runs.arguments import (
    facts,
    names_in,
    names_listed,
    numbers_of,
    refuse_given,
    require_positive_if_given,
)
from dln_jax.runs.evaluation import bands_of
from dln_jax.runs.folder import command_folder
from dln_jax.runs.report import Report, finish, png
from dln_jax.types import FrictionLaw, InputError
from dln_jax.zoo.descriptions import Description
from dln_jax.zoo.run import save

SETTLED = (*SPLIT, "friction", "condition")
"""Checks of a log that the robot's file and this command make unnecessary."""
FITTED = "identified"
"""Name of the parameters that the run keeps; the others come from the file and from least squares."""


def run(options: Arguments) -> None:
    """Identifies the robot, evaluates the model and writes the run folder.

    Raises:
        InputError: a mistake in the options or data, before anything is written.
        FitRefused: the model must not be used; the run folder is complete.
    """
    require_positive_if_given(options, ["velocity_scale", "window"])
    if options.by == "torques":
        refuse_given(options, ["window"], "for --by motions or both")
    laws, cooling = stated_friction(options.friction)
    robot = read_robot(options.robot, lock=names_listed(options.lock))
    more = f" --robot {options.robot}" + (f" --lock '{options.lock}'" if options.lock else "")
    of_file = {"needs": robot.tree.needs, "needs_origin": "the robot's file", "settled": SETTLED, "more": more}
    log = read_log(options.data, robot=robot, **of_file, **facts(options))
    robot = log.robot or robot
    log = log._replace(robot=robot)
    tree, names = robot.tree, robot.tree.names
    motors, coupled = stated_motors(options, tree.degrees_of_freedom)
    if cooling:
        reference_temperature(log.data)  # refuses data without temperature
    parts = split_log(log, options.test, validation=False)
    train, test = parts.sets.train, parts.sets.test
    logs = [train, test]
    if options.by != "torques" and log.measured is not None:
        light = log._replace(data=lightly_filtered(log.measured, log.smoothed))
        lighter = split_log(light, options.test, validation=False).sets
        logs += [lighter.train, lighter.test]

    with command_folder(options, "identify") as folder:
        whole_blocks = parts.blocks and not is_cut(options.test)
        kind = "blocks of time of the one trajectory" if whole_blocks else "trajectories or parts of them"
        print(f"{options.robot.name}: {len(names)} joints, {', '.join(names)}")
        print(f"{options.data.name}: {len(train.t)} samples fitted, {len(test.t)} held out ({kind})")
        if train.joint_names is None:
            print("the data have no joint_names; joints are assumed to be in this order")
        for line in (*log.remarks, *parts.remarks):
            print(line)
        if options.lock:
            print(f"locked: {', '.join(names_listed(options.lock))}")

        began = time.perf_counter()
        description, friction, of_terms = describe_rigid_tree(
            robot,
            tree.needs._replace(joint_friction=laws),
            train,
            velocity_scale=options.velocity_scale,
            cooling=cooling,
            motors=motors,
            coupled=coupled,
        )
        model, known = build_rigid_tree(description, robot)
        at, fitted = None, logs
        if friction is not None:
            fitted = at_reference(description, model, friction.parameters, *logs)
            at = friction.parameters if "load" in description["needs"]["joint_friction"] else None
        settings = {"joints": tree.joints, "at": at, "robust": options.robust}
        solution = identify(model, known, fitted[0], **settings)
        by_torques, by_motions, of_motions = solution.theta, None, []
        if options.by != "torques":
            window, both = options.window, (fitted[0], fitted[2])
            if window is None:
                window, line = choose_window(options.by, model, known, *both, **settings)
                of_motions.append(line)
            solution, by_motions = refit(options.by, model, known, solution, *both, window)
        parameters = parameters_of(solution.theta, known)
        seconds = time.perf_counter() - began
        fit = Fit(model, parameters, description, needs=tree.needs)
        save(folder, description, parameters)

        train, test, *motions = at_reference(description, model, parameters, *logs)
        predict = predictor(model)
        sources = {"file": solution.known, "least_squares": solution.fit.theta, FITTED: solution.theta}
        predicted = {name: predict(parameters_of(theta, known), test) for name, theta in sources.items()}
        torques = {name: torque for name, (torque, _) in predicted.items()}
        errors = {name: normalised_error(torque, test.tau) for name, torque in torques.items()}
        metrics: dict[str, float | int] = {
            "parameters": len(solution.theta),
            "base_parameters": len(solution.base.words),
            "rank": solution.fit.rank,
            "condition": solution.fit.condition,
            "identify_seconds": seconds,
        }
        for name, error in errors.items():
            prefix = "" if name == FITTED else f"{name}_"
            metrics[f"{prefix}torque_mse"] = mean_square(torques[name] - test.tau)
            metrics[f"{prefix}nmse"] = float(np.nanmean(error))
            metrics |= {f"{prefix}nmse_joint_{k + 1}": float(value) for k, value in enumerate(error)}
        metrics |= {f"noise_joint_{k + 1}": float(value) for k, value in enumerate(solution.fit.noise)}
        if solution.consistent is not None:
            metrics["consistent_iterations"] = solution.consistent.iterations
        if motions:
            variance = spread_of(*motions)
            for name, theta in {"vpt_seconds": solution.theta, "by_torques_vpt_seconds": by_torques}.items():
                times, length = prediction_times(model, parameters_of(theta, known), motions[1], variance)
                metrics |= {"predicted_seconds": length, name: float(np.mean(times))}
            of_motions += motion_lines(options.by, by_motions, metrics)
        if by_motions is not None:
            metrics |= {"delay_seconds": by_motions.delay, "rounds": by_motions.rounds}
            metrics |= {"motion_rms_before": by_motions.before, "motion_rms": by_motions.after}
        verdict, of_verdict = judge_robot(
            solution,
            known,
            description,
            predict,
            train,
            test,
            torques,
            log,
            robust=options.robust,
            whole=by_motions is not None and bool(np.isclose(metrics["vpt_seconds"], metrics["predicted_seconds"])),
        )
        metrics |= of_verdict

        units = ["N m" if kind == "revolute" else "N" for kind in tree.joints]
        figures: dict[str, Callable[[Path], None]] = {}
        if options.figures:
            figures["torque.png"] = png(torque_bands, test, torques[FITTED], model=fit.name, names=names)
            if description["needs"]["joint_friction"]:
                # All joints at once, each over its own range: friction in a joint does not depend on the others.
                rates = np.linspace(test.qd.min(axis=0), test.qd.max(axis=0), len(test.t))
                still = np.zeros_like(rates)
                curves = predict(parameters, test._replace(q=still, qd=rates, qdd=still))[1]
                torque, friction = predicted[FITTED]
                figures["friction.png"] = png(
                    friction_curves,
                    {"identified": (rates, curves)},
                    names=names,
                    measured=(test.qd, test.tau - (torque - friction)),
                    joints=tree.joints,
                )
        if options.uncertainty:
            try:
                inner = Parts(Split(*inner_split(train), test))
            except InputError:
                print("no uncertainty is stored: it takes at least two trajectories or blocks to fit")
            else:
                fit = with_uncertainty(fit, inner, log.torque, print, unit=solution.fit.noise)
                fit.save(folder)
            of_bands, bands = bands_of(fit, test, torques[FITTED])
            metrics |= of_bands
            figures |= bands

        write_json(folder / "parameters.json", {"base": base_rows(solution), "parameters": parameter_rows(solution)})
        write_bytes(folder / "report.txt", text(solution).encode())
        copy = folder / f"{options.robot.stem}_identified{options.robot.suffix}"
        of_file = f"no {copy.name}: the fit is refused"
        if verdict.level != "refused":
            of_file = write_identified(copy, options, robot, description, parameters)
        rms = np.sqrt(np.mean((torques[FITTED] - test.tau) ** 2, axis=0))
        rows = [
            (name, *(f"{error[k]:.3g}" for error in errors.values()), f"{rms[k]:.3g}", f"{noise:.3g}", unit)
            for k, (name, noise, unit) in enumerate(zip(names, solution.fit.noise, units, strict=True))
        ]
        rows.append(("mean", *(f"{np.nanmean(error):.3g}" for error in errors.values()), "", "", ""))
        report = Report(
            metrics,
            rows,
            "held-out nMSE by parameters, rms error, and noise of the fit",
            columns=("joint", *(name.replace("_", " ") for name in predicted), "rms", "noise", "unit"),
            verdict=verdict,
            figures=figures,
            chosen=description,
            lines=(
                *of_motions,
                *summary(solution),
                *shape_lines(description),
                *of_terms,
                *findings(solution, train, names),
                of_file,
                "report.txt lists all parameters",
            ),
        )
        finish(folder, options, report)


def stated_friction(text: str) -> tuple[tuple[FrictionLaw, ...], bool]:
    """Friction laws of --friction, and whether viscous friction may fall with temperature."""
    stated = [] if text == NO_FRICTION else names_in("--friction", text, (*LAWS, TEMPERATURE))
    laws = cast(tuple[FrictionLaw, ...], tuple(name for name in stated if name != TEMPERATURE))
    require_laws(laws, "--friction")
    if TEMPERATURE in stated and not {"viscous", "asymmetric"} & set(laws):
        raise InputError("--friction: temperature changes viscous friction, which is missing; add viscous to it")
    return laws, TEMPERATURE in stated


def stated_motors(options: Arguments, d: int) -> tuple[Rows | None, tuple[Pair, ...]]:
    """Rows of --motors, and pairs of joints of --coupled, counted from 0."""
    rows, pairs = None, []
    if options.motors is not None:
        rows = tuple(numbers_of("--motors", row, [d]) for row in options.motors.split(";"))
        if len(rows) != d:
            raise InputError(f"--motors has {len(rows)} rows; expected {d}, one per motor, separated by semicolons")
    for pair in names_listed(options.coupled):
        try:
            first, second = sorted(int(joint) - 1 for joint in pair.split(":"))
        except ValueError:
            raise InputError(f"--coupled has {pair!r:.40}; expected pairs of joints such as 2:3") from None
        pairs.append((first, second))
    try:
        require_motors(rows, pairs, d)
    except InputError as error:
        raise InputError(f"--{error}") from None
    return rows, tuple(pairs)


def predictor(model: Model) -> Predict:
    """(parameters, data) -> torque [N, d], and its friction part [N, d]; compiled once per N."""

    def one(parameters: Parameters, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array]:
        motion = dynamics(model.energies(parameters))
        return motion.inverse_dynamics(q, qd, qdd), motion.friction(q, qd)

    every = compiled(jax.vmap(one, in_axes=(None, 0, 0, 0)))
    return lambda parameters, data: jax.tree.map(np.asarray, every(parameters, data.q, data.qd, data.qdd))


def shape_lines(description: Description) -> list[str]:
    """Fitted shape parameters of friction, in addition to its coefficients."""
    reference = f"1/K about {description['reference_temperature']:g} °C"
    units = {"sigmoid_slope": "s", "load": "of the torque that the gear carries", "cooling": reference}
    return [
        f"{name.replace('_', ' ')}: {', '.join(f'{value:.3g}' for value in values)} {units.get(name, 'rad/s or m/s')}"
        for name in (*shape_of(description["needs"]["joint_friction"]), "load", "cooling")
        if isinstance(values := description[name], list)
    ]


def write_identified(
    path: Path, options: Arguments, robot: Robot, description: Description, parameters: RigidTreeParameters
) -> str:
    """Writes the robot's file with the identified parameters; returns a line on what it omits, or why it is missing."""
    motors = description["motors"]
    armature = armature_matrix(parameters.armature, motors, pairs_of(parameters.coupling))
    tree = robot.tree._replace(inertias=np.asarray(parameters.inertias), armature=np.asarray(armature))
    remarks = [f"Identified from {options.data.name}."]
    named = parameters.friction._asdict().items()
    coefficients = {name: np.asarray(values) for name, values in named if values is not None}
    damping, coulomb = (coefficients.pop(name, None) for name in ("viscous", "coulomb"))
    for name, values in coefficients.items():
        pairs = ", ".join(f"{joint} {value!r}" for joint, value in zip(tree.names, values.tolist(), strict=True))
        remarks.append(f"Friction that the file cannot state, {name}: {pairs}.")
    remarks += [f"Not in this file: {line}." for line in shape_lines(description) if line.startswith(("load", "cool"))]
    try:
        write_robot(
            path,
            options.robot,
            tree,
            damping=damping,
            coulomb=coulomb,
            motors=motors,
            lock=names_listed(options.lock),
            remarks=tuple(remarks),
        )
    except InputError as error:
        return f"no {path.name}: {error}"
    lacks = "; armature is in a comment, because URDF cannot state it" * (path.suffix == ".urdf")
    return f"{path.name}: the robot's file with these values{lacks}"
