"""Networks, trained by an optimiser under a checkpoint: one seed, several in one program, or networks that grow."""

from pathlib import Path
from typing import Any

import numpy as np
from jax.sharding import Mesh

from dln_jax.data.splits import Split, drawn, merged, select
from dln_jax.learning import dynamics
from dln_jax.learning.dynamics import MANY_JOINTS, Suited, suited_network
from dln_jax.learning.engine.checkpoint import Checkpoint
from dln_jax.learning.engine.fit import fit as train_problem
from dln_jax.learning.engine.problem import Problem, Training, require_finite_start
from dln_jax.learning.objectives import Objective
from dln_jax.runs.arguments import refuse_given, require_positive_if_given, resolved
from dln_jax.runs.optimisers import name_of, optimiser_named
from dln_jax.runs.progress import progress
from dln_jax.sizes import require_network
from dln_jax.training.dynamics.methods.growth import grow_to_target
from dln_jax.training.dynamics.options import NETWORK, AdamOptions, NetworkOptions
from dln_jax.training.dynamics.recorded import Recorded
from dln_jax.training.dynamics.task import Method, Solver, Task, seeds_of
from dln_jax.training.results import losses
from dln_jax.types import InputError, require_positive, require_seed
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import build, describe_for

OF_ADAM = tuple(AdamOptions.__dataclass_fields__)
WITHOUT_STRUCTURE = 400
"""Default number of iterations of a black box, which converges later than a structured network."""


def plan(options: Any, kind: str, recorded: Recorded, objective: Objective) -> tuple[dict[str, Any], Solver]:
    """Plans the network and its optimiser: as stated, or as the sizes of model and data suggest."""
    check(options)
    needs, sets, optimizer = recorded.needs, recorded.sets, options.optimizer
    suited = suited_to_many_joints(options, kind, recorded)
    optimizer = optimizer if suited is None else suited.optimizer
    adam = optimizer == "adam"
    precision = options.precision or ("f32" if adam else "f64")
    # A structured model needs fewer units; first-order training needs more.
    width = 64 if adam else 8 if CATALOGUE[kind].properties.definite else 16
    keywords = resolved(options, {"width": width, "depth": 2, "activation": "tanh"})
    keywords |= {} if suited is None else suited.keywords
    require_network(width=keywords["width"], depth=keywords["depth"])
    description = describe_for(kind, sets.train, needs, precision=precision, **keywords)
    reason = "" if suited is None else suited.reason
    if optimizer == "auto":
        suited_kind, reason = dynamics.suited_optimiser(build(description), sets, objective)
        optimizer = name_of(suited_kind)
        description["precision"] = precision = options.precision or ("f32" if optimizer == "adam" else "f64")
    settings = {name: getattr(options, name, None) for name in (*OF_ADAM, "steps", "target")}
    samples = getattr(options, "samples", None)
    if optimizer == "gauss-newton" and not CATALOGUE[kind].properties.definite:
        settings["steps"] = options.steps or WITHOUT_STRUCTURE
    if suited is not None:
        settings["steps"] = suited.steps if options.steps is None else options.steps
        samples = suited.samples if samples is None else samples
    optimiser, seeds = optimiser_named(optimizer, precision=precision, **settings), seeds_of(options)
    model = build(description)
    require_finite_start(
        dynamics.problem(model, sets, objective, seeds=seeds), dynamics.samples(model, sets, objective)
    )
    return description, Solver(optimiser, reason, posed(description, sets, objective, samples, seeds), samples)


def check(options: Any) -> None:
    """Refuses numbers out of range, and options that --target decides."""
    require_positive(seeds=options.seeds, folds=options.folds)
    require_seed(options.seed, options.seeds)
    require_positive_if_given(options, ["seconds", "target"])
    if getattr(options, "target", None) is None:
        return
    if options.optimizer == "adam" or options.seeds > 1:
        raise InputError("--target grows one structured network by gauss-newton; leave the other options out")
    refuse_given(options, ["width", "depth"], "what --target grows")
    if hasattr(options, "samples"):
        refuse_given(options, ["samples"], "for one network, and --target grows several")


def suited_to_many_joints(options: Any, kind: str, recorded: Recorded) -> Suited | None:
    """The structured network, optimiser and samples that suit data of four joints or more, unless they are stated."""
    sized = options.width is None and options.depth is None and getattr(options, "target", None) is None
    many = recorded.needs.degrees_of_freedom >= MANY_JOINTS
    if kind == NETWORK and options.optimizer == "auto" and sized and many:
        return suited_network(recorded.needs, recorded.sets.train)
    return None


def posed(
    description: dict[str, Any], sets: Split, objective: Objective, samples: int | None, seeds: int | tuple[int, ...]
) -> Problem:
    """The fitting problem of a model; `samples` training samples are drawn, scaled by the spread of all of them."""
    scale, some = objective.scale(sets.train), sets
    if samples is not None:
        some = sets._replace(train=drawn(sets.train, samples, seeds if isinstance(seeds, int) else seeds[0]))
    return dynamics.problem(build(description), some, objective._replace(scale=lambda data: scale), seeds=seeds)


def fit(task: Task, options: NetworkOptions, folder: Path, mesh: Mesh | None) -> tuple[Task, Training]:
    """Trains the network; cross-validation selects one of several seeds, and --target grows networks."""
    solver, resume = solver_of(task), getattr(options, "resume", False)
    if (target := getattr(options, "target", None)) is not None:
        return grow_to_target(task, solver.optimiser, target, folder, resume=resume, mesh=mesh)
    several = options.seeds > 1 and options.folds > 1
    fits = options.folds + 1 if several else 1
    training = train(task, solver, folder, resume=resume, mesh=mesh, fits=fits)
    if several:
        task = cross_validated(task, solver, folder, folds=options.folds, resume=resume, mesh=mesh)
    return task, training


def solver_of(task: Task) -> Solver:
    """Returns the solver from `plan`.

    Raises:
        InputError: another `plan` made the task, and it has no solver.
    """
    if task.solver is None:
        raise InputError(f"{task.kind} was planned without an optimiser; plan it with the method of networks")
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
    text = ", ".join(f"{seed}: {error:.2e}" for seed, error in zip(np.ravel(task.seeds), errors, strict=True))
    print(f"cross-validated errors by seed, {folds} folds: {text}")
    return task._replace(best=int(np.argmin(np.nan_to_num(errors, nan=np.inf))))


METHOD = Method(plan, fit)
