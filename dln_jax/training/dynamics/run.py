"""Trains a task of dynamics into a run folder: the model, its errors, its speed and its verdict."""

from pathlib import Path

import numpy as np

from dln_jax.cli.optimisers import name_of
from dln_jax.cli.running import command_folder
from dln_jax.cli.scaled import mesh_of
from dln_jax.cli.stored_arguments import write_config
from dln_jax.data.splits import merged
from dln_jax.files import write_json
from dln_jax.learning.engine.optimisers import Adam
from dln_jax.learning.engine.problem import Training
from dln_jax.learning.objectives import SCALED_TORQUE, require_scales, torque_scale
from dln_jax.scale.devices import device_lines
from dln_jax.training.dynamics.methods import METHODS
from dln_jax.training.dynamics.model_selection import train_selected
from dln_jax.training.dynamics.options import AUTO, Options, with_model
from dln_jax.training.dynamics.planning import check_options, task_of
from dln_jax.training.dynamics.programs import programs_ahead, programs_of
from dln_jax.training.dynamics.recorded import Recorded, read
from dln_jax.training.dynamics.results import best_seed, definiteness_of, evaluate, print_metrics
from dln_jax.training.dynamics.task import Task
from dln_jax.training.dynamics.uncertainty import store_uncertainty
from dln_jax.training.dynamics.verdict import refuse, say
from dln_jax.training.results import settings_of
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.run import load, save


def run(given: Options, command: str) -> None:
    """Trains, evaluates and writes a run folder, by default runs/`command`-1, -2, ...

    Raises:
        InputError: no validation error is finite, or the loss became non-finite; the last good parameters are kept.
        FitRefused: the model predicts held-out torques no better than a constant, and neither --steps nor --seconds cut
            its training short; the run folder is complete.
    """
    given, chosen_for = with_model(given)
    mesh, recorded = mesh_of(given), read(given)
    chosen = None
    if given.model == AUTO:
        check_options(given, AUTO)
        require_scales(recorded.sets.train)
    else:
        chosen = task_of(given, recorded)
    with command_folder(given, command) as folder:
        announce(recorded, chosen_for)
        if chosen is None:
            task, training = train_selected(given, recorded, folder, mesh)
            programs = programs_of(task, mesh)
        else:
            announce_model(chosen)
            fixed = chosen.solver is not None and given.target is None  # the fit does not change its description
            ahead = programs_ahead(chosen, mesh, uncertainty=given.uncertainty) if fixed else None
            task, training = METHODS[chosen.kind].fit(chosen, given, folder, mesh)
            programs = ahead or programs_of(task, mesh)
        if training.stop.reason != "not finite" and not np.isfinite(training.validation).any():
            raise InputError(
                f"no validation error is finite; {folder} holds no model; look for large numbers in the data"
            )
        parameters, best = best_seed(training, given.seeds, task.best)
        save(folder, task.description, parameters)
        if given.uncertainty:
            store_uncertainty(folder, task, programs.double, parameters)
        unit = torque_scale(task.sets.train).tolist() if task.objective is SCALED_TORQUE else None
        options = {"seeds": given.seeds, "figures": given.figures, "low_latency": given.low_latency}
        metrics, judged = evaluate(folder, task, training, programs, **options)
        write_json(folder / "metrics.json", metrics)
        optimiser = {} if task.solver is None else settings_of(task.solver.optimiser)
        more = {"cutoff_hz": recorded.cutoff, "validation_units": unit}
        more = {name: value for name, value in more.items() if value is not None}
        more |= {} if judged.verdict is None else {"verdict": judged.verdict._asdict()}
        write_config(folder, given, **task.description, **optimiser, **more, seeds=task.seeds)
        print_metrics(metrics, task)
        if given.seeds > 1:
            by = "validation" if task.best is None else "cross-validation"
            print(f"the run keeps seed {given.seed + best}, the best in {by}")
        print(f"run folder: {folder}")
        warn(task, training, folder)
        say(judged)
        refuse(judged, task, given)


def announce(recorded: Recorded, chosen_for: str) -> None:
    """Prints the data used for training and the assumptions made."""
    counts = ", ".join(f"{len(part.t)} {role}" for role, part in recorded.sets._asdict().items())
    needs = recorded.needs
    terms = [name for name in ("gravity", "friction") if getattr(needs, name)] or ["no potential, no friction"]
    print(f"{recorded.name}: {counts} samples")
    print(f"{'-'.join(needs.joints)} with {' and '.join(terms)} ({recorded.needs_origin})")
    if needs.joint_friction:
        print(f"friction of joints: {', '.join(needs.joint_friction)}")
    for line in (*recorded.said, *([chosen_for] if chosen_for else [])):
        print(line)


def announce_model(task: Task) -> None:
    """Prints the model to train and its optimiser."""
    if CATALOGUE[task.kind].properties.canonical and task.objective.of_torques:
        print("no momenta p in the data: the Hamiltonian is fitted to torques")
    if task.solver is not None:
        why = f" ({task.solver.reason})" if task.solver.reason else ""
        print(f"{task.kind}, {task.precision}, {name_of(task.solver.optimiser)}{why}")
    for line in device_lines(task.precision):
        print(line)


def warn(task: Task, training: Training, folder: Path) -> None:
    """Warns about indefinite mass matrices and about a training that ended early."""
    found = definiteness_of(load(folder).dynamics, task, merged(task.sets))
    if found is not None and found.share_not_definite > 0:
        properties = CATALOGUE[task.kind].properties
        structured = f"--model {'structured-hnn' if properties.canonical else 'structured-delan'}"
        remedy = f"another --degree, {structured}" if "degree" in task.description else structured
        print(
            f"the mass matrix is not positive definite at {found.share_not_definite:.1%} of the states of the data: "
            f"accelerations and rollouts are wrong or infinite there; try {remedy}, or more varied motions"
        )
    if training.stop.reason == "no improvement":
        print(f"stopped early, at step {training.stop.step}: no better validation error for --patience steps")
    if training.stop.reason == "time":
        print(f"out of time at step {training.stop.step}: kept is the best so far; --resume continues")
    if training.stop.reason == "not finite":
        adam = task.solver is not None and isinstance(task.solver.optimiser, Adam)
        remedy = "lower --learning-rate or use --precision f64" if adam else "check the data"
        raise InputError(
            f"the loss stopped being finite after step {training.stop.step}; {folder} holds the last good one; {remedy}"
        )
