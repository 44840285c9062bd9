"""Uncertainty of a trained model of dynamics: estimated, stored with the run, tested and drawn."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.figures.torques import torque_bands
from dln_jax.files import write_figure
from dln_jax.learning.linear import linearised_chunks
from dln_jax.learning.uncertainty import estimate
from dln_jax.metrics.coverage import LEVEL, coverage
from dln_jax.models.model import Model
from dln_jax.models.uncertainty import Uncertainty, highest, scores_of_rows, torque_deviation
from dln_jax.training.dynamics.programs import CHUNK, Programs
from dln_jax.training.dynamics.task import Task
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.run import Run
from dln_jax.zoo.uncertainty_files import save_uncertainty


def store_uncertainty(folder: Path, task: Task, model: Model, parameters: Any) -> None:
    """Estimates and stores the uncertainty of a model fitted to torques alone, from training and validation data.

    `model` is the task's model in float64.
    """
    if not task.objective.of_torques:
        print(f"a {task.kind} is not fitted to torques alone: the run does not say what it does not know")
        return
    properties, tree = CATALOGUE[task.kind].properties, "tree" in task.description
    if properties.kernel:
        print(f"a {task.kind} has as many parameters as data: the run does not say what it does not know")
        return
    try:
        found = estimate(
            model,
            parameters,
            task.sets.train,
            task.sets.validation,
            ridge=0.0 if properties.linear else None,
            negligible=1e-12 * tree,
        )
    except (InputError, np.linalg.LinAlgError) as error:
        # The model is trained, so an estimate that its data cannot provide is left out instead of refused.
        print(f"the run does not say what it does not know: {error}")
        return
    facts = {"ridge": found.ridge, "degrees_of_freedom": found.degrees_of_freedom.tolist()}
    save_uncertainty(folder, found.uncertainty, **facts, torque=task.recorded.torque)
    print(f"bands are of {task.recorded.torque}, for one more motion of the kind that was recorded")


def uncertainty_metrics(
    folder: Path, run: Run, task: Task, programs: Programs, predicted: np.ndarray, *, figures: bool
) -> dict[str, float]:
    """Coverage of the 95 % bands on test torques (mean, worst joint), and the share of test states out of distribution.

    Draws `uncertainty.png`. Empty for a run without uncertainty.
    """
    if run.uncertainty is None:
        return {}
    test = task.sets.test
    std, outside = bands(programs.double, run.parameters, run.uncertainty, test)
    shares = coverage(predicted - test.tau, std, levels=(LEVEL,)).shares[0]
    if figures:
        write_figure(folder / "uncertainty.png", torque_bands(test, predicted, std, outside, model=task.kind))
    return {
        "coverage_95_share": float(shares.mean()),
        "coverage_95_worst_joint_share": float(shares[np.argmax(abs(shares - LEVEL))]),
        "outside_share": float(outside.mean()),
    }


def bands(model: Model, parameters: Any, uncertainty: Uncertainty, data: Trajectories) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations of the torques [N, d], and whether the samples are out of distribution [N].

    Reuses the program that the estimate compiled to linearise the torques; `Run.torque_std` would compile it again.
    """
    found, first = [], 0
    with jax.enable_x64(True):
        parameters = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), parameters)
        for rows, *_ in linearised_chunks(model, parameters, data, CHUNK):
            part = slice(first, first + len(rows))
            found.append(_bands(uncertainty, rows, (data.q[part], data.qd[part], data.qdd[part])))
            first = part.stop
    std, outside = zip(*found, strict=True)
    return np.concatenate(std), np.concatenate(outside)


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0))
def _bands(uncertainty: Uncertainty, rows: Any, state: tuple[Any, ...]) -> tuple[Any, Any]:
    return torque_deviation(rows, uncertainty), ~(highest(scores_of_rows(rows, state, uncertainty)) <= 1)
