"""Trains dynamics, as a kind of the pipeline: the model, its errors, its speed and its verdict."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jax.sharding import Mesh

from dln_jax.learning.engine.optimisers import Adam
from dln_jax.learning.engine.problem import Training
from dln_jax.learning.objectives import SCALED_TORQUE, torque_scale
from dln_jax.models.model import Model, Parameters
from dln_jax.runs.optimisers import name_of
from dln_jax.runs.report import Report
from dln_jax.scale.devices import device_lines
from dln_jax.time_limit import deadline
from dln_jax.training.dynamics.options import NETWORK, model_of, network_option
from dln_jax.training.dynamics.programs import Programs, programs_ahead, programs_of
from dln_jax.training.dynamics.recorded import read
from dln_jax.training.dynamics.results import best_seed, columns, evaluate, rows
from dln_jax.training.dynamics.task import Task, method_of, planned
from dln_jax.training.pipeline import Fitted, Kind, train
from dln_jax.training.results import settings_of
from dln_jax.training.uncertainty import store_uncertainty
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import CATALOGUE


class Outcome(NamedTuple):
    """A training of dynamics."""

    task: Task
    training: Training
    programs: Programs
    best: int
    """Index of the seed that is kept."""


def run(options: Any, command: str) -> None:
    """Trains, evaluates and writes a run folder; errors as for `training.pipeline.train`."""
    model = model_of(vars(options))
    if options.model is None and model == NETWORK and options.data is not None:
        option = network_option(vars(options))
        print(f"{option} is for networks, so the model is {NETWORK}; without it several are tried (--model auto)")
    train(DYNAMICS, dataclasses.replace(options, model=model), command)


def prepare(options: Any) -> Task:
    """Reads the data and plans the model that the options name."""
    return planned(options, options.model, read(options), deadline(getattr(options, "seconds", None)))


def announce(task: Task) -> Iterator[str]:
    """Lines on the data, the assumptions, and the model and its optimiser."""
    recorded, needs = task.recorded, task.needs
    counts = ", ".join(f"{len(part.t)} {role}" for role, part in recorded.sets._asdict().items())
    terms = [name for name in ("gravity", "friction") if getattr(needs, name)] or ["no potential, no friction"]
    yield f"{recorded.name}: {counts} samples"
    yield f"{'-'.join(needs.joints)} with {' and '.join(terms)} ({recorded.needs_origin})"
    if needs.joint_friction:
        yield f"friction of joints: {', '.join(needs.joint_friction)}"
    yield from recorded.lines
    if not task.description:  # model selection announces its candidates as it goes
        return
    if CATALOGUE[task.kind].properties.canonical and task.objective.of_torques:
        yield "no momenta p in the data: the Hamiltonian is fitted to torques"
    if task.solver is not None:
        why = f" ({task.solver.reason})" if task.solver.reason else ""
        yield f"{task.kind}, {task.precision}, {name_of(task.solver.optimiser)}{why}"
    yield from device_lines(task.precision)


def fit(task: Task, options: Any, folder: Path, mesh: Mesh | None) -> Fitted:
    """Fits the model; the programs that evaluate it compile meanwhile, if the fit does not change its description."""
    fixed = task.solver is not None and getattr(options, "target", None) is None
    ahead = programs_ahead(task, mesh, uncertainty=options.uncertainty) if fixed else None
    task, training = method_of(task.kind).fit(task, options, folder, mesh)
    if training.stop.reason != "not finite" and not np.isfinite(training.validation).any():
        raise InputError(f"no validation error is finite; {folder} holds no model; look for large numbers in the data")
    parameters, best = best_seed(training, np.size(task.seeds) if task.solver is not None else 1, task.best)
    return Fitted(task.description, parameters, Outcome(task, training, ahead or programs_of(task, mesh), best))


def judge(task: Task, fitted: Fitted, options: Any, folder: Path) -> Report:
    """Errors, speed, uncertainty and verdict of the stored model, with the figures that apply."""
    task, training, programs, best = fitted.outcome
    if options.uncertainty:
        store_bands(folder, task, programs.double, fitted.parameters)
    seeds = getattr(options, "seeds", 1)
    evaluation = evaluate(folder, task, training, programs, seeds=seeds)
    unit = torque_scale(task.sets.train).tolist() if task.objective is SCALED_TORQUE else None
    more = {"cutoff_hz": task.recorded.cutoff, "validation_units": unit}
    chosen = {**task.description, **({} if task.solver is None else settings_of(task.solver.optimiser))}
    chosen |= {name: value for name, value in more.items() if value is not None} | {"seeds": task.seeds}
    lines = []
    if seeds > 1:
        by = "validation" if task.best is None else "cross-validation"
        lines.append(f"the run keeps seed {options.seed + best}, the best in {by}")
    if task.refinement is not None:
        lines.append(task.refinement.line)
    limits = [getattr(options, name, None) for name in ("steps", "seconds")]
    return Report(
        metrics=evaluation.metrics,
        rows=rows(evaluation.metrics, task),
        title=f"test on {task.name}, {task.precision}",
        columns=columns(evaluation.metrics),
        verdict=evaluation.verdict,
        figures=evaluation.figures,
        chosen=chosen,
        lines=(*lines, *warnings(task, training)),
        ended_by_user=task.solver is not None and limits != [None, None],
        error=failure(task, training, folder),
    )


def store_bands(folder: Path, task: Task, model: Model, parameters: Parameters) -> None:
    """Stores the uncertainty of a model fitted to torques alone; for other models, prints why there is none."""
    properties = CATALOGUE[task.kind].properties
    if not task.objective.of_torques:
        print(f"no uncertainty is stored: a {task.kind} is not fitted to torques alone")
        return
    if properties.kernel:
        print(f"no uncertainty is stored: a {task.kind} has as many parameters as data")
        return
    sets, ridge = task.sets, 0.0 if properties.linear else None
    negligible = 1e-12 if "tree" in task.description else 0.0
    options = {"ridge": ridge, "negligible": negligible}
    store_uncertainty(folder, model, parameters, sets.train, sets.validation, task.recorded.torque, **options)


def warnings(task: Task, training: Training) -> Iterator[str]:
    """Lines on forces known only in sum, and on a training that ended early."""
    if task.summed:
        yield f"gravity and friction of joints {task.summed} are known only in sum; the potential takes any constant"
    if training.stop.reason == "no improvement":
        yield f"stopped early, at step {training.stop.step}: no better validation error for --patience steps"
    if training.stop.reason == "time":
        yield f"out of time at step {training.stop.step}: kept is the best so far; --resume continues"


def failure(task: Task, training: Training, folder: Path) -> str:
    """Why the training failed; empty if it did not."""
    if training.stop.reason != "not finite":
        return ""
    adam = task.solver is not None and isinstance(task.solver.optimiser, Adam)
    remedy = "lower --learning-rate or use --precision f64" if adam else "check the data"
    return f"the loss stopped being finite after step {training.stop.step}; {folder} holds the last good one; {remedy}"


DYNAMICS = Kind(prepare, announce, fit, judge)
