"""The result of a fit: a model with its parameters, history and settings."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.log import Parts
from dln_jax.learning import dynamics
from dln_jax.learning.dynamics import summed_with_friction
from dln_jax.learning.engine.optimisers import Optimiser
from dln_jax.learning.engine.problem import Progress, Stop, Training
from dln_jax.learning.kinematics.fit import TreeFit
from dln_jax.learning.objectives import SCALED_TORQUE, Objective
from dln_jax.learning.uncertainty import estimate
from dln_jax.models.model import Model, Parameters
from dln_jax.precision import data_type
from dln_jax.types import InputError, Needs
from dln_jax.zoo.catalogue import CATALOGUE, Properties
from dln_jax.zoo.descriptions import Description, build
from dln_jax.zoo.parameter_files import save_uncertainty
from dln_jax.zoo.run import Run, save


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Run):
    """A fitted model of dynamics, with its functions, history and settings."""

    model: Model
    needs: Needs = Needs(joints=("revolute",))  # noqa: RUF009  replaced by every fit
    """Joints and terms of the model."""
    training: Training = Training(None, [], Stop("finished", 0), 0, 0.0)  # noqa: RUF009
    """History and stop; its parameters have a leading axis if several seeds were trained."""
    objective: Objective = SCALED_TORQUE
    optimiser: Optimiser | None = None
    """The optimiser; `None` for a direct fit."""
    samples: int | None = None
    """Number of training samples that a network draws; `None` for all."""
    seeds: int | tuple[int, ...] = 0
    """One seed, or several trained in one program."""
    best: int = 0
    """Index of the best seed."""
    cross_validated: bool = False
    """Whether cross-validation chose the seed."""
    search: TreeFit | None = None
    """The search for the joint frames of a learned tree."""
    facts: Any = None
    """JSON values that record the estimate of the uncertainty."""
    report: Any = None
    """The evaluation, a `runs.report.Report`."""

    @property
    def name(self) -> str:
        """Name of the model in the catalogue."""
        return self.description["name"]

    @property
    def properties(self) -> Properties:
        """Properties of the model by construction."""
        return CATALOGUE[self.name].properties

    def summed(self, parts: Parts) -> list[int]:
        """Returns the joints, counted from 1, for which the data determine only the sum of gravity and friction."""
        return summed_with_friction(self.needs, parts.sets.train, network=self.optimiser is not None)

    def of_seed(self, index: int) -> Parameters:
        """Returns the parameters of one of several seeds."""
        if isinstance(self.seeds, int):
            return self.training.parameters
        return jax.tree.map(lambda leaf: leaf[index], self.training.parameters)

    def save(self, folder: str | Path) -> None:
        """Writes the model and its uncertainty into a folder for `dln_jax.load`; replaces an existing model."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        save(folder, self.description, self.parameters)
        if self.uncertainty is not None:
            save_uncertainty(folder, self.uncertainty, **(self.facts or {}))


def direct_fit(
    description: Description,
    needs: Needs,
    parts: Parts,
    parameters: Parameters,
    objective: Objective = SCALED_TORQUE,
    *,
    loss: float = math.nan,
    seconds: float = 0.0,
    search: TreeFit | None = None,
) -> Fit:
    """Wraps a direct fit as a one-step training history."""
    model, dtype = build(description), data_type(description["precision"])
    parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), parameters)
    errors = dynamics.validation_errors(model, parts.sets, parameters, objective)
    at = Progress(1, loss, float(np.mean(errors)), math.nan, seconds)
    training = Training(parameters, [at], Stop("finished", 1), 1, 0.0)
    return Fit(model, parameters, description, needs=needs, training=training, objective=objective, search=search)


def with_uncertainty(fit: Fit, parts: Parts, torque: str, say: Callable[[str], None], *, unit: Any = None) -> Fit:
    """Adds the uncertainty of the torques, or reports why the fit has none.

    Args:
        torque: name of the fitted torque, for the report.
        unit: scales of the joints' residuals in the fit, N m or N (default: the spread of the torques).
    """
    if not fit.objective.of_torques:
        say(f"no uncertainty is stored: this {fit.name} was not fitted to torques alone")
        return fit
    if fit.properties.kernel:
        say(f"no uncertainty is stored: a {fit.name} has as many parameters as data")
        return fit
    try:
        solution = estimate(
            double(fit),
            fit.parameters,
            parts.sets.train,
            parts.sets.validation,
            unit=unit,
            ridge=0.0 if fit.properties.linear else None,
            negligible=1e-12 if "tree" in fit.description else 0.0,
        )
    except (InputError, np.linalg.LinAlgError) as error:
        # The model itself is fine, so a failed estimate is reported and left out.
        say(f"no uncertainty is stored: {error}")
        return fit
    say(f"Bands cover {torque} of a new motion like the recorded ones.")
    facts = {"ridge": solution.ridge, "degrees_of_freedom": solution.degrees_of_freedom.tolist(), "torque": torque}
    return dataclasses.replace(fit, uncertainty=solution.uncertainty, facts=facts)


def double(fit: Fit) -> Model:
    """Builds the model of a fit in float64."""
    return build({**fit.description, "precision": "f64"})
