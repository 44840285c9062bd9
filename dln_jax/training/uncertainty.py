"""Uncertainty of a trained model's torques: estimated, stored with the run, tested and drawn."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.figures.torques import torque_bands
from dln_jax.learning.linear import design, design_chunks
from dln_jax.learning.uncertainty import estimate
from dln_jax.metrics.coverage import LEVEL, coverage
from dln_jax.models.model import Model, Parameters
from dln_jax.models.uncertainty import Uncertainty, deviation_of_rows, exceeds, scores_of_rows
from dln_jax.runs.report import png
from dln_jax.types import InputError
from dln_jax.zoo.run import load
from dln_jax.zoo.uncertainty_files import save_uncertainty

CHUNK = 256
"""Number of samples per call of the program that linearises the torques in the parameters."""


def store_uncertainty(
    folder: Path,
    model: Model,
    parameters: Parameters,
    train: Trajectories,
    validation: Trajectories,
    torque: str,
    **options: Any,
) -> None:
    """Estimates the uncertainty of a model fitted to torques, and stores it in the run's folder.

    Args:
        model: the model in float64.
        train: data that the parameters were fitted to.
        validation: data that calibrate the bands.
        torque: description of the torques that the bands refer to.
        options: as for `learning.uncertainty.estimate`.
    """
    try:
        solution = estimate(model, parameters, train, validation, **options)
    except (InputError, np.linalg.LinAlgError) as error:
        # The model is trained, so an estimate that its data cannot provide is left out instead of refused.
        print(f"no uncertainty is stored: {error}")
        return
    facts = {"ridge": solution.ridge, "degrees_of_freedom": solution.degrees_of_freedom.tolist()}
    save_uncertainty(folder, solution.uncertainty, **facts, torque=torque)
    print(f"bands are of {torque}, for one more motion of the kind that was recorded")


def uncertainty_metrics(
    folder: Path, model: Model, test: Trajectories, predicted: np.ndarray, name: str
) -> tuple[dict[str, float], dict[str, Callable[[Path], None]]]:
    """Coverage of the stored 95 % bands on test torques, share of test states out of distribution, and their figure.

    Empty for a run without uncertainty.

    Args:
        predicted: the model's torques on the test data [N, d].
    """
    run = load(folder)
    if run.uncertainty is None:
        return {}, {}
    std, out_of_distribution = bands(model, run.parameters, run.uncertainty, test)
    shares = coverage(predicted - test.tau, std, levels=(LEVEL,)).shares[0]
    metrics = {
        "coverage_95_share": float(shares.mean()),
        "coverage_95_worst_joint_share": float(shares[np.argmax(abs(shares - LEVEL))]),
        "out_of_distribution_share": float(out_of_distribution.mean()),
    }
    return metrics, {"uncertainty.png": png(torque_bands, test, predicted, std, out_of_distribution, model=name)}


def bands(model: Model, parameters: Any, uncertainty: Uncertainty, data: Trajectories) -> tuple[np.ndarray, np.ndarray]:
    """Deviations of the torques [N, d] and out-of-distribution flags [N], by the program that the estimate compiled."""
    parts, first = [], 0
    with jax.enable_x64(True):
        parameters = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), parameters)
        for rows, *_ in design_chunks(design(model), parameters, data, CHUNK, even=False):
            part = slice(first, first + len(rows))
            parts.append(_bands(uncertainty, rows, (data.q[part], data.qd[part], data.qdd[part])))
            first = part.stop
    std, out_of_distribution = zip(*parts, strict=True)
    return np.concatenate(std), np.concatenate(out_of_distribution)


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0))
def _bands(uncertainty: Uncertainty, rows: Any, state: tuple[Any, ...]) -> tuple[Any, Any]:
    std = deviation_of_rows(rows, uncertainty.factor, uncertainty.noise, uncertainty.inflation)
    return std, exceeds(scores_of_rows(rows, state, uncertainty))
