"""Fits models of dynamics to trajectories: builds the problem that `engine.fit` solves.

training = fit(problem(model, sets, objective), GaussNewton())
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.data.splits import Split
from dln_jax.learning import objectives
from dln_jax.learning.engine import optimisers
from dln_jax.learning.engine.checkpoint import identity
from dln_jax.learning.engine.optimisers import Optimiser
from dln_jax.learning.engine.problem import Problem
from dln_jax.learning.objectives import TORQUE, Objective
from dln_jax.models.model import Model, Parameters
from dln_jax.types import require_seed


def problem(model: Model, sets: Split, objective: Objective = TORQUE, *, seeds: int | Sequence[int] = 0) -> Problem:
    """Builds the problem of fitting a model to an objective, in the precision of the model.

    Args:
        model: from `dln_jax.models`.
        sets: samples for training, for selecting the parameters, and for monitoring.
        objective: residual to minimise, from `learning.objectives`.
        seeds: seeds of the initial parameters and of the order of the samples. Several seeds train in one program, and
            the results have a leading axis of seeds.

    Raises:
        InputError: the data cannot determine the model, lack a key of the objective, or overflow in the model's
            precision.
    """
    for seed in (seeds,) if isinstance(seeds, int) else seeds:
        require_seed(seed)
    scale, (fitted, selected_by, monitored) = _read(model, sets, objective)
    held_out = tuple(map(lambda *pair: jnp.concatenate(pair), selected_by, monitored))

    def residual(parameters: Parameters, *sample: Array) -> Array:
        return objective.residual(model.energies(parameters), *sample) / scale

    def score(parameters: Parameters) -> tuple[Array, Array]:
        squares = _squares(objective, model, parameters, held_out, scale)
        return squares[: len(selected_by[0])].mean(), squares[len(selected_by[0]) :].mean()

    if isinstance(seeds, int):
        return Problem(residual, jax.jit(model.init)(jax.random.key(seeds)), fitted, score, seeds)
    numbers = jnp.asarray(seeds)
    initial = jax.jit(lambda each: jax.lax.map(lambda seed: model.init(jax.random.key(seed)), each))
    return Problem(residual, initial(numbers), fitted, score, numbers)


def samples(model: Model, sets: Split, objective: Objective = TORQUE) -> tuple[Array, ...]:
    """All arrays that are read for fitting, selecting and monitoring, in the model's precision."""
    return tuple(map(lambda *parts: jnp.concatenate(parts), *_read(model, sets, objective)[1]))


def identity_of(
    optimiser: Optimiser, sets: Split, objective: Objective = TORQUE, *, seeds: int | Sequence[int] = 0
) -> dict[str, Any]:
    """Returns the identity by which a `Checkpoint` recognises a training."""
    return identity(optimiser, (getattr(data, key) for data in sets for key in objective.keys), seeds=seeds)


def suited_optimiser(model: Model, sets: Split, objective: Objective = TORQUE) -> tuple[type[Optimiser], str]:
    """Returns the optimiser that suits the sizes of the model and the data, and the reason."""
    return optimisers.suited(_shapes(model), len(sets.train.t), len(objective.scale(sets.train)))


def validation_errors(
    model: Model, sets: Split, parameters: Parameters, objective: Objective = TORQUE
) -> Float[np.ndarray, " N"]:
    """Squared error of every validation sample; their mean selects the parameters."""
    scale, (_, batch, _) = _read(model, sets, objective)
    return np.asarray(jax.jit(lambda given: _squares(objective, model, given, batch, scale))(parameters))


def _shapes(model: Model) -> Parameters:
    return jax.eval_shape(model.init, jax.random.key(0))


def _read(model: Model, sets: Split, objective: Objective) -> tuple[Array, list[tuple[Array, ...]]]:
    """Returns the scale of the residuals, and the arrays of every set."""
    dtype = jnp.result_type(*jax.tree.leaves(_shapes(model)))
    return objective.scale(sets.train).astype(dtype), [objectives.arrays(objective, data, dtype) for data in sets]


def _squares(objective: Objective, model: Model, parameters: Any, batch: tuple[Array, ...], scale: Array) -> Array:
    """Squared error of every sample of a batch, in the units in which the objective selects parameters."""
    errors = objectives.residuals(objective, model.energies(parameters), batch)
    return jnp.sum((errors if objective.selects_by == "torque" else errors / scale) ** 2, axis=1)
