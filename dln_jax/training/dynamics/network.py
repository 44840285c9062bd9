"""Trains the model of a task with its optimiser, under a checkpoint."""

from pathlib import Path

import numpy as np
from jax.sharding import Mesh

from dln_jax.cli.progress import progress
from dln_jax.data.splits import Split, merged, select
from dln_jax.learning import dynamics
from dln_jax.learning.engine.checkpoint import Checkpoint
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.problem import Training
from dln_jax.training.dynamics.task import Solver, Task, posed
from dln_jax.training.results import losses


def train(task: Task, solver: Solver, folder: Path, *, resume: bool, mesh: Mesh | None, fits: int = 1) -> Training:
    """Trains the task's model, with one seed or several, in its share of the time left for `fits` fits."""
    total = solver.optimiser.steps
    identity = dynamics.identity_of(solver.optimiser, task.sets, task.objective, seeds=task.seeds)
    with progress(total) as show:
        return fit(
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
        training = fit(
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
