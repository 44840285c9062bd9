"""Additions to an identified rigid robot: a residual network and the uncertainty of torques."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.compilation import quick_compilation
from dln_jax.errors import InputError
from dln_jax.identification.identify import Identification, parameters_of
from dln_jax.identification.residual import Candidate, ResidualFit, fit_residual
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction.laws import shape_of
from dln_jax.metrics.errors import normalised_error
from dln_jax.models.model import Model, Parameters
from dln_jax.training.identification.task import Case, for_residual
from dln_jax.training.uncertainty import store_uncertainty
from dln_jax.zoo.descriptions import Description, describe

ADDED = "with_residual"
"""Key of predictions with the residual network."""


class Predictions(NamedTuple):
    """Predictions for held-out samples."""

    torque: Float[np.ndarray, "N d"]
    friction: Float[np.ndarray, "N d"]
    """Friction, which is part of `torque`."""


Predict = Callable[[Parameters, np.ndarray, np.ndarray, np.ndarray], Predictions]


def predictor(model: Model) -> Predict:
    """(parameters, q, qd, qdd [N, d] each) -> torque and friction; compiled once per N."""

    def one(parameters: Parameters, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array]:
        motion = dynamics(model.energies(parameters))
        return motion.inverse_dynamics(q, qd, qdd), motion.friction(q, qd)

    every = jax.jit(jax.vmap(one, in_axes=(None, 0, 0, 0)), compiler_options=quick_compilation())
    return lambda *arguments: Predictions(*map(np.asarray, every(*arguments)))


def add_residual(case: Case, kept: Parameters) -> ResidualFit:
    """Fits a residual network to the identified robot, or selects none."""
    train, validation = for_residual(case.sets.train)
    return fit_residual(case.model, kept, case.robot.tree.needs, train, validation)


def stored_description(case: Case, added: ResidualFit | None) -> Description:
    """Description of the model that the run keeps."""
    return case.description if added is None or not added.settings else with_network(case.description, added)


def with_network(description: Description, added: ResidualFit) -> Description:
    """Description of a model with its residual network."""
    keywords = {key: value for key, value in description.items() if key not in ("name", "precision")}
    return describe(f"{description['name']}-residual", precision="f64", **keywords, **added.settings)


def judge_residual(case: Case, added: ResidualFit, metrics: dict[str, float | int]) -> "Predictions":
    """Held-out torques with the residual network; adds their errors to the metrics."""
    test = case.sets.test
    predicted = predictor(added.model)(added.parameters, test.q, test.qd, test.qdd)
    errors = normalised_error(predicted.torque, test.tau)
    metrics[f"{ADDED}_nmse"] = float(np.nanmean(errors))
    metrics |= {f"{ADDED}_nmse_joint_{k + 1}": float(value) for k, value in enumerate(errors)}
    return predicted


def shape_lines(case: Case) -> list[str]:
    """Fitted shape parameters of friction, in addition to its coefficients."""
    named = (*shape_of(case.laws), "load", "cooling")
    shapes = {name: case.description[name] for name in named if isinstance(case.description[name], list)}
    reference = f"1/K about {case.description['reference_temperature']:g} °C"
    units = {"sigmoid_slope": "s", "load": "of the torque that the gear carries", "cooling": reference}
    return [
        f"{name.replace('_', ' ')}: {', '.join(f'{value:.3g}' for value in values)} {units.get(name, 'rad/s or m/s')}"
        for name, values in shapes.items()
    ]


def residual_lines(added: ResidualFit | None) -> list[str]:
    """Networks tried, and the one selected."""
    if added is None:
        return []
    tried = ", ".join(f"{_named(trial.candidate)}: {trial.validation:.3g}" for trial in added.trials)
    return [f"residual, validation error by network: {tried}; chosen: {_named(added.chosen)}"]


def _named(candidate: Candidate) -> str:
    return f"{'+'.join(candidate.terms)} {candidate.width}" if candidate.terms else "none"


def store_bands(folder: Path, case: Case, solution: Identification, added: ResidualFit | None) -> Model:
    """Stores the uncertainty of the run's model, and returns the model.

    The calibration includes the motions that the tree's few parameters were fitted to, as if each had been left out.
    """
    model, parameters, ridge = case.model, parameters_of(solution.theta, case.known), 0.0
    if added is not None and added.settings:
        model, parameters, ridge = added.model, added.parameters, None
    options = {"ridge": ridge, "unit": solution.fit.noise, "negligible": 1e-12}
    try:
        parts = for_residual(case.sets.train)
    except InputError:
        print("no uncertainty is stored: two trajectories or blocks to fit are the least that it takes")
        return model
    store_uncertainty(folder, model, parameters, *parts, case.torque, **options)
    return model
