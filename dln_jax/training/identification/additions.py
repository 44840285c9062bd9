"""Additions to an identified rigid robot: a residual network and the uncertainty of torques."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.compilation import quick_compilation
from dln_jax.figures.torques import torque_bands
from dln_jax.files import write_figure
from dln_jax.identification.identify import Identification, parameters_of
from dln_jax.identification.residual import Candidate, ResidualFit, fit_residual
from dln_jax.learning.uncertainty import estimate
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import shape_of
from dln_jax.metrics.coverage import LEVEL, coverage
from dln_jax.metrics.errors import normalised_error
from dln_jax.models.model import Model, Parameters
from dln_jax.training.identification.task import Case, for_residual
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import Description, describe
from dln_jax.zoo.run import load
from dln_jax.zoo.uncertainty_files import save_uncertainty

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
    found = {name: case.description[name] for name in shape_of(case.laws) if isinstance(case.description[name], list)}
    units = {"sigmoid_slope": "s"}
    return [
        f"{name.replace('_', ' ')}: {', '.join(f'{value:.3g}' for value in values)} {units.get(name, 'rad/s or m/s')}"
        for name, values in found.items()
    ]


def residual_lines(added: ResidualFit | None) -> list[str]:
    """Networks tried, and the one selected."""
    if added is None:
        return []
    tried = ", ".join(f"{_named(trial.candidate)}: {trial.validation:.3g}" for trial in added.trials)
    return [f"residual, validation error by network: {tried}; chosen: {_named(added.chosen)}"]


def _named(candidate: Candidate) -> str:
    return f"{'+'.join(candidate.terms)} {candidate.width}" if candidate.terms else "none"


def store_uncertainty(
    folder: Path, case: Case, found: Identification, added: ResidualFit | None, *, figures: bool
) -> dict[str, float | int]:
    """Stores the uncertainty with the run, draws it, and returns the coverage of the 95 % bands on held-out torques.

    The calibration includes the motions that the tree's few parameters were fitted to, as if each had been left out.
    """
    extended = added is not None and bool(added.settings)
    model, parameters = (
        (added.model, added.parameters) if added and extended else (case.model, parameters_of(found.theta, case.known))
    )
    try:
        train, validation = for_residual(case.sets.train)
        known = estimate(
            model,
            parameters,
            train,
            validation,
            ridge=None if extended else 0.0,
            unit=found.fit.noise,
            negligible=1e-12,
        )
    except (InputError, np.linalg.LinAlgError) as error:
        print(f"the run does not say what it does not know: {error}")
        return {}
    facts = {"ridge": known.ridge, "degrees_of_freedom": known.degrees_of_freedom.tolist(), "torque": case.torque}
    save_uncertainty(folder, known.uncertainty, **facts)
    print(f"bands are of {case.torque}, for one more motion of the kind that was recorded")
    run, test = load(folder), case.sets.test
    state = tuple(map(jnp.asarray, (test.q, test.qd, test.qdd)))
    inverse = run.dynamics.inverse_dynamics
    predicted, std, outside = (
        np.asarray(jax.jit(jax.vmap(each), compiler_options=quick_compilation())(*state))
        for each in (inverse, run.torque_std, run.outside)
    )
    shares = coverage(predicted - test.tau, std, levels=(LEVEL,)).shares[0]
    if figures:
        name = case.description["name"]
        write_figure(folder / "uncertainty.png", torque_bands(test, predicted, std, outside, model=name))
    return {
        "coverage_95_share": float(shares.mean()),
        "coverage_95_worst_joint_share": float(shares[np.argmax(abs(shares - LEVEL))]),
        "outside_share": float(outside.mean()),
    }
