"""Training a task of dynamics into a run folder: the model, its errors, its speed, and what is to be said of it."""

from pathlib import Path

import numpy as np

from dln_jax.command_line.optimisers import name_of
from dln_jax.command_line.progress import progress
from dln_jax.command_line.running import command_folder, write_config
from dln_jax.data.splits import merged
from dln_jax.files import write_json
from dln_jax.learning import dynamics
from dln_jax.learning.engine.checkpoint import Checkpoint
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam
from dln_jax.learning.engine.problem import Training
from dln_jax.learning.objectives import TORQUE
from dln_jax.runs.direct_fits import fit_directly
from dln_jax.runs.dynamics_growth import grow_to_target
from dln_jax.runs.dynamics_results import best_seed, definiteness_of, evaluate, latency_states, print_metrics
from dln_jax.runs.dynamics_task import Options, Solver, Task, prepare
from dln_jax.runs.dynamics_uncertainty import store_uncertainty
from dln_jax.runs.results import losses, settings_of
from dln_jax.studies.speed.low_latency_calls import low_latency_metrics
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.run import load, save


def run(given: Options, command: str) -> None:
    """Trains what the options name, evaluates it, and writes the run folder, by default runs/`command`-1, -2, ...

    Raises:
        InputError: no error is finite, or the loss stopped being so; what was good before that is kept.
    """
    task = prepare(given)
    with command_folder(given, command) as folder:
        announce(task)
        if task.solver is None:
            task, training = fit_directly(task, given)
        elif given.target is not None:
            task, training = grow_to_target(task, task.solver.optimiser, given.target, folder, resume=given.resume)
        else:
            training = train(task, task.solver, folder, resume=given.resume)
        if training.stop.reason != "not finite" and not np.isfinite(training.validation).any():
            raise InputError(
                f"no validation error is finite; {folder} holds no model; look for large numbers in the data"
            )
        parameters, best = best_seed(training, given.seeds)
        save(folder, task.description, parameters)
        if given.uncertainty:
            store_uncertainty(folder, task, parameters)
        metrics = evaluate(folder, task, training, seeds=given.seeds, figures=given.figures)
        if given.low_latency:
            metrics |= low_latency_metrics(folder, latency_states(task), print)
        write_json(folder / "metrics.json", metrics)
        optimiser = {} if task.solver is None else settings_of(task.solver.optimiser)
        filtered = {} if task.cutoff is None else {"cutoff_hz": task.cutoff}
        write_config(folder, given, **task.description, **optimiser, **filtered, seeds=task.seeds)
        print_metrics(metrics, task)
        if given.seeds > 1:
            print(f"the run keeps seed {given.seed + best}, the best in validation")
        print(f"run folder: {folder}")
        warn(task, training, folder)


def announce(task: Task) -> None:
    """Says what is trained on what, and what was assumed."""
    counts = ", ".join(f"{len(part.t)} {role}" for role, part in task.sets._asdict().items())
    joints = "-".join(task.needs.joints)
    terms = [name for name in ("gravity", "friction") if getattr(task.needs, name)] or ["no potential, no friction"]
    print(f"{task.name}: {counts} samples")
    print(f"{joints} with {' and '.join(terms)} ({task.needs_origin})")
    if task.needs.joint_friction:
        print(f"friction of joints: {', '.join(task.needs.joint_friction)}")
    for line in task.said:
        print(line)
    if CATALOGUE[task.kind].properties.canonical and task.objective is TORQUE:
        print("no momenta p in the data: the Hamiltonian is fitted to torques")
    if task.solver is not None:
        why = f" ({task.solver.reason})" if task.solver.reason else ""
        print(f"{task.kind}, {task.precision}, {name_of(task.solver.optimiser)}{why}")


def train(task: Task, solver: Solver, folder: Path, *, resume: bool) -> Training:
    """Trains the task's model, one seed or several."""
    total = solver.optimiser.steps
    identity = dynamics.identity_of(solver.optimiser, task.sets, task.objective, seeds=task.seeds)
    with progress(total) as show:
        return fit(
            solver.problem,
            solver.optimiser,
            checkpoint=Checkpoint(folder, identity, resume),
            report=lambda at: show(min(int(np.max(at.step)), total), losses(at)),
            seconds=task.seconds,
        )


def warn(task: Task, training: Training, folder: Path) -> None:
    """Says what a user should know about how training ended, and of what came of it."""
    found = definiteness_of(load(folder).dynamics, task, merged(task.sets))
    if found is not None and found.share_not_definite > 0:
        properties = CATALOGUE[task.kind].properties
        structured = f"--model {'structured-hnn' if properties.canonical else 'structured-delan'}"
        remedy = f"another --degree, {structured}" if properties.linear else structured
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
