"""What a training of dynamics does not know: estimated, stored with the run, held against the test, and drawn."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.figures.uncertainty import torque_bands
from dln_jax.files import write_figure
from dln_jax.learning.uncertainty import estimate
from dln_jax.metrics.coverage import LEVEL, coverage
from dln_jax.precision import data_type
from dln_jax.training.dynamics.task import Task
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import Run
from dln_jax.zoo.uncertainty_files import save_uncertainty


def store_uncertainty(folder: Path, task: Task, parameters: Any) -> None:
    """Estimates it by the training and validation trajectories; of models that are fitted to torques alone."""
    if not task.objective.of_torques:
        print(f"a {task.kind} is not fitted to torques alone: the run does not say what it does not know")
        return
    properties, tree = CATALOGUE[task.kind].properties, "tree" in task.description
    if properties.kernel:
        print(f"a {task.kind} has as many parameters as data: the run does not say what it does not know")
        return
    model = build({**task.description, "precision": "f64"})
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
        # The model is trained: what its data cannot tell is left out, not refused.
        print(f"the run does not say what it does not know: {error}")
        return
    facts = {"ridge": found.ridge, "degrees_of_freedom": found.degrees_of_freedom.tolist()}
    save_uncertainty(folder, found.uncertainty, **facts, torque=task.recorded.torque)
    print(f"bands are of {task.recorded.torque}, for one more motion of the kind that was recorded")


def uncertainty_metrics(
    folder: Path, run: Run, task: Task, predicted: np.ndarray, *, figures: bool
) -> dict[str, float]:
    """How often test torques are within the bands of 95 %, in all and at the joint where that is furthest from it, and
    the share of test states that are outside the training data; draws `uncertainty.png`. None for a run without."""
    if run.uncertainty is None:
        return {}
    test, dtype = task.sets.test, data_type(task.precision)
    state = tuple(jnp.asarray(array, dtype) for array in (test.q, test.qd, test.qdd))
    std, outside = (np.asarray(jax.jit(jax.vmap(each))(*state)) for each in (run.torque_std, run.outside))
    shares = coverage(predicted - test.tau, std, levels=(LEVEL,)).shares[0]
    if figures:
        write_figure(folder / "uncertainty.png", torque_bands(test, predicted, std, outside, model=task.kind))
    return {
        "coverage_95_share": float(shares.mean()),
        "coverage_95_worst_joint_share": float(shares[np.argmax(abs(shares - LEVEL))]),
        "outside_share": float(outside.mean()),
    }
