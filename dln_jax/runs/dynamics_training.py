"""Training the model of a task with the optimiser that it has, under a checkpoint."""

from pathlib import Path

import numpy as np
from jax.sharding import Mesh

from dln_jax.command_line.progress import progress
from dln_jax.learning import dynamics
from dln_jax.learning.engine.checkpoint import Checkpoint
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.problem import Training
from dln_jax.runs.dynamics_task import Solver, Task
from dln_jax.runs.results import losses


def train(task: Task, solver: Solver, folder: Path, *, resume: bool, mesh: Mesh | None) -> Training:
    """Trains the task's model, one seed or several, by the devices of the mesh."""
    total = solver.optimiser.steps
    identity = dynamics.identity_of(solver.optimiser, task.sets, task.objective, seeds=task.seeds)
    with progress(total) as show:
        return fit(
            solver.problem,
            solver.optimiser,
            checkpoint=Checkpoint(folder, identity, resume),
            report=lambda at: show(min(int(np.max(at.step)), total), losses(at)),
            seconds=task.seconds,
            mesh=mesh,
        )
