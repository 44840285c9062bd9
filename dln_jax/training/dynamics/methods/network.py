"""Networks, trained by an optimiser under a checkpoint: one seed, several in one program, or networks that grow."""

from pathlib import Path
from typing import Any

import numpy as np
from jax.sharding import Mesh

from dln_jax.cli.arguments import refuse_given, resolved
from dln_jax.cli.optimisers import name_of, optimiser_named
from dln_jax.cli.progress import progress
from dln_jax.data.splits import Split, drawn, merged, select
from dln_jax.learning import dynamics
from dln_jax.learning.dynamics import MANY_JOINTS, suited_network
from dln_jax.learning.engine.checkpoint import Checkpoint
from dln_jax.learning.engine.fit import fit as train_problem
from dln_jax.learning.engine.problem import Problem, Training, require_finite_start
from dln_jax.learning.objectives import Objective
from dln_jax.sizes import require_network
from dln_jax.training.dynamics.methods.growth import grow_to_target
from dln_jax.training.dynamics.options import OF_ADAM, Options
from dln_jax.training.dynamics.recorded import Recorded
from dln_jax.training.dynamics.task import Method, Solver, Task, seeds_of
from dln_jax.training.results import losses
from dln_jax.types import InputError, require_positive
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import build, describe_for


def check(given: Options, kind: str) -> None:
    """Refuses options of other models, and what does not go with --target."""
    refuse_given(given, ["degree"], "for the trigonometric model")
    if given.target is None:
        return
    if kind != "structured-delan" or given.optimizer == "adam" or given.seeds > 1:
        raise InputError("--target grows one structured network by gauss-newton; leave the other options out")
    refuse_given(given, ["width", "depth"], "what --target grows")
    refuse_given(given, ["samples"], "for one network, and --target grows several")
    require_positive(target=given.target)


def plan(given: Options, kind: str, recorded: Recorded, objective: Objective) -> tuple[dict[str, Any], Solver]:
    """The network and its optimiser: as stated, or as the size of the model and the data suggest."""
    needs, sets, optimizer = recorded.needs, recorded.sets, given.optimizer
    suited = None
    sized = given.width is None and given.depth is None and given.target is None
    if kind == "structured-delan" and optimizer == "auto" and sized and needs.degrees_of_freedom >= MANY_JOINTS:
        suited = suited_network(needs, sets.train)
        optimizer = suited.optimizer
    adam = optimizer == "adam"
    precision = given.precision or ("f32" if adam else "f64")
    # A structured model needs fewer units; first-order training needs more.
    width = 64 if adam else 8 if CATALOGUE[kind].properties.definite else 16
    keywords = resolved(given, {"width": width, "depth": 2, "activation": "tanh"})
    keywords |= {} if suited is None else suited.keywords
    require_network(width=keywords["width"], depth=keywords["depth"])
    description = describe_for(kind, sets.train, needs, precision=precision, **keywords)
    reason = "" if suited is None else suited.reason
    if optimizer == "auto":
        suited_kind, reason = dynamics.suited_optimiser(build(description), sets, objective)
        optimizer = name_of(suited_kind)
        description["precision"] = precision = given.precision or ("f32" if optimizer == "adam" else "f64")
    if optimizer == "gauss-newton":
        chosen = "auto chose gauss-newton" if reason else "the optimizer is gauss-newton"
        refuse_given(given, OF_ADAM, f"for adam, but {chosen}: add --optimizer adam")
    elif given.samples is not None:
        chosen = "auto chose adam: add --optimizer gauss-newton" if reason else "the optimizer is adam"
        raise InputError(f"--samples is for gauss-newton, but {chosen}; or leave it out")
    settings = {name: getattr(given, name) for name in (*OF_ADAM, "steps", "target")}
    if suited is not None and given.steps is None:
        settings["steps"] = suited.steps
    samples = given.samples if suited is None or given.samples is not None else suited.samples
    optimiser, seeds = optimiser_named(optimizer, precision=precision, **settings), seeds_of(given)
    model = build(description)
    require_finite_start(
        dynamics.problem(model, sets, objective, seeds=seeds), dynamics.samples(model, sets, objective)
    )
    return description, Solver(optimiser, reason, posed(description, sets, objective, samples, seeds), samples)


def posed(
    description: dict[str, Any], sets: Split, objective: Objective, samples: int | None, seeds: int | tuple[int, ...]
) -> Problem:
    """The fitting problem of a model; `samples` training samples are drawn, scaled by the spread of all of them."""
    scale, some = objective.scale(sets.train), sets
    if samples is not None:
        some = sets._replace(train=drawn(sets.train, samples, seeds if isinstance(seeds, int) else seeds[0]))
    return dynamics.problem(build(description), some, objective._replace(scale=lambda data: scale), seeds=seeds)


def fit(task: Task, given: Options, folder: Path, mesh: Mesh | None) -> tuple[Task, Training]:
    """Trains the network; of several seeds cross-validation prefers one; --target grows networks."""
    solver = solver_of(task)
    if given.target is not None:
        return grow_to_target(task, solver.optimiser, given.target, folder, resume=given.resume, mesh=mesh)
    several = given.seeds > 1 and given.folds > 1
    fits = given.folds + 1 if several else 1
    training = train(task, solver, folder, resume=given.resume, mesh=mesh, fits=fits)
    if several:
        task = cross_validated(task, solver, folder, folds=given.folds, resume=given.resume, mesh=mesh)
    return task, training


def solver_of(task: Task) -> Solver:
    """The solver that `plan` has made."""
    assert task.solver is not None
    return task.solver


def train(task: Task, solver: Solver, folder: Path, *, resume: bool, mesh: Mesh | None, fits: int = 1) -> Training:
    """Trains the task's model, with one seed or several, in its share of the time left for `fits` fits."""
    total = solver.optimiser.steps
    identity = dynamics.identity_of(solver.optimiser, task.sets, task.objective, seeds=task.seeds)
    with progress(total) as show:
        return train_problem(
            solver.problem,
            solver.optimiser,
            checkpoint=Checkpoint(folder, identity, resume),
            report=lambda at: show(min(int(np.max(at.step)), total), losses(at)),
            seconds=task.seconds / fits,
            mesh=mesh,
        )


def cross_validated(task: Task, solver: Solver, folder: Path, *, folds: int, resume: bool, mesh: Mesh | None) -> Task:
    """Selects the seed with the lowest cross-validation error over folds of the motions.

    One or two validation motions often prefer the worse of two seeds. Every motion outside the test is in one fold.
    """
    rest = merged(task.sets._replace(test=select(task.sets.test, [])))
    motions = np.random.default_rng(np.ravel(task.seeds)[0]).permutation(np.unique(rest.trajectory))
    total = np.zeros(len(np.ravel(task.seeds)))
    folds = min(folds, len(motions))
    for number, held in enumerate(np.array_split(motions, folds)):
        sets = Split(select(rest, np.setdiff1d(motions, held)), select(rest, held), task.sets.test)
        identity = dynamics.identity_of(solver.optimiser, sets, task.objective, seeds=task.seeds)
        training = train_problem(
            posed(task.description, sets, task.objective, solver.samples, task.seeds),
            solver.optimiser,
            checkpoint=Checkpoint(folder, identity, resume, f"checkpoint_fold_{number + 1}"),
            seconds=task.seconds / (folds - number),
            mesh=mesh,
        )
        total += np.asarray(training.validation) * len(sets.validation.t)
    errors = total / len(rest.t)
    said = ", ".join(f"{seed}: {error:.2e}" for seed, error in zip(np.ravel(task.seeds), errors, strict=True))
    print(f"cross-validated errors by seed, {folds} folds: {said}")
    return task._replace(best=int(np.argmin(np.nan_to_num(errors, nan=np.inf))))


NETWORK = Method(check, plan, fit)
