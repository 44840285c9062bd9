"""Training of a model of dynamics on trajectories: split in, best parameters out, resumable at any dispatch."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split
from dln_jax.learning import objectives as residuals
from dln_jax.learning.engine.first_order import train_first_order
from dln_jax.learning.engine.optimisers import adamw, check_adamw
from dln_jax.learning.engine.runs import (
    CHECKPOINT,
    Checkpoint,
    Report,
    Training,
    fingerprint,
    require_finite_start,
    require_start,
    silent,
)
from dln_jax.learning.engine.second_order import Budget, choose_optimizer, train_second_order
from dln_jax.learning.objectives import TORQUE, Objective
from dln_jax.models.model import Model, Parameters
from dln_jax.precision import data_type, require_float64
from dln_jax.types import InputError, require_positive, require_seed

OPTIMIZERS = ("adam", "gauss-newton")


class Settings(NamedTuple):
    """How to train; all of it decides the result, none of it where the result goes."""

    optimizer: str = "adam"
    """adam (AdamW on minibatches) or gauss-newton (Levenberg-Marquardt on all samples, f64)."""
    steps: int = 20_000
    """Of Adam, or iterations of Gauss-Newton."""
    batch: int = 512
    """Of Adam, like the learning rate, the weight decay and the patience."""
    learning_rate: float = 5e-3
    """Peak, reached after warm-up and followed by cosine decay."""
    weight_decay: float = 1e-5
    patience: int = 10_000
    """Steps without a better validation error after which training stops."""
    seconds: float = math.inf
    """After which training stops, compilation included and since the call, also of a resumed run; looked at between
    dispatches, of which there is one at least."""
    target: float = 0.0
    """Validation error at which Gauss-Newton stops."""
    precision: str = "f32"
    """f32 or f64."""
    seed: int = 0


def check(sets: Split, settings: Settings, objective: Objective = TORQUE) -> None:
    """Raises `InputError` if the settings are out of range, or the data cannot determine the model."""
    require_positive(**{name: getattr(settings, name) for name in ("steps", "batch", "patience", "seconds")})
    check_adamw(learning_rate=settings.learning_rate, weight_decay=settings.weight_decay)
    require_seed(settings.seed)
    data_type(settings.precision)
    if settings.optimizer not in OPTIMIZERS:
        raise InputError(f"optimizer is '{settings.optimizer}'; expected one of {', '.join(OPTIMIZERS)}")
    if settings.optimizer == "gauss-newton":
        require_float64(settings.precision)
    objective.scale(sets.train)
    for part in sets:
        residuals.arrays(objective, part, data_type(settings.precision))


def check_start(model: Model, sets: Split, settings: Settings, objective: Objective = TORQUE) -> None:
    """Raises `InputError` if a set's loss is not finite where training starts; takes a compilation."""
    dtype = data_type(settings.precision)
    scale = objective.scale(sets.train).astype(dtype)
    require_finite_start(
        lambda parameters, batch: residuals.mean_loss(objective, model.energies(parameters), batch, scale),
        model.init,
        settings.seed,
        tuple(map(lambda *parts: jnp.concatenate(parts), *(residuals.arrays(objective, part, dtype) for part in sets))),
    )


def train(
    model: Model,
    sets: Split,
    settings: Settings,
    *,
    objective: Objective = TORQUE,
    seeds: Sequence[int] | None = None,
    directory: Path | None = None,
    name: str = CHECKPOINT,
    resume: bool = False,
    report: Report = silent,
) -> Training:
    """Fits a model to an objective, keeping the parameters with the lowest validation error.

    Args:
        model: from `dln_jax.models`, its parameters of the type that `settings.precision` names.
        sets: what to fit, to select by, and to monitor.
        settings: how to train.
        objective: what to make small, from `learning.objectives`.
        seeds: several seeds for one program, in place of `settings.seed`; the split is the same for all, and the
            result has them on the leading axis.
        directory: existing folder for a checkpoint after every dispatch; `None` for none.
        name: of the checkpoint.
        resume: continue from the checkpoint in that folder, if there is one, bit for bit as if never interrupted.
        report: called after every dispatch.

    Raises:
        InputError: what `check` finds, a loss that is not finite to begin with, or a checkpoint that does not fit.
    """
    check(sets, settings, objective)
    dtype = data_type(settings.precision)
    scale = objective.scale(sets.train).astype(dtype)
    fitted, selected_by, monitored = (residuals.arrays(objective, data, dtype) for data in sets)
    held_out = tuple(map(lambda *pair: jnp.concatenate(pair), selected_by, monitored))

    def score(parameters: Parameters) -> tuple[Array, Array]:
        squares = _squares(objective, model, parameters, held_out, scale)
        return squares[: len(selected_by[0])].mean(), squares[len(selected_by[0]) :].mean()

    checkpoint = None
    if directory is not None:
        # Time is no part of what decides the result: a run may continue with more of it.
        stated = {**settings._asdict(), "seconds": None, **({} if seeds is None else {"seeds": list(seeds)})}
        numbers = fingerprint(array for data in sets for array in _numbers(data, objective))
        checkpoint = Checkpoint(directory, {"settings": stated, "data": numbers}, resume, name)
    parameters = initial_parameters(model, settings.seed if seeds is None else seeds)

    if settings.optimizer == "gauss-newton":
        trained = train_second_order(
            lambda parameters, *sample: objective.residual(model.energies(parameters), *sample) / scale,
            parameters,
            fitted,
            score=score,
            budget=Budget(settings.steps, seconds=settings.seconds, target=settings.target),
            seeds=seeds is not None,
            checkpoint=checkpoint,
            report=report,
        )
        return require_start(trained)
    trained = train_first_order(
        lambda parameters, batch: residuals.mean_loss(objective, model.energies(parameters), batch, scale),
        adamw(steps=settings.steps, learning_rate=settings.learning_rate, weight_decay=settings.weight_decay),
        parameters,
        fitted,
        score=score,
        seed=settings.seed if seeds is None else jnp.asarray(seeds),
        steps=settings.steps,
        batch=settings.batch,
        patience=settings.patience,
        seconds=settings.seconds,
        checkpoint=checkpoint,
        report=report,
    )
    return require_start(trained)


def initial_parameters(model: Model, seeds: int | Sequence[int]) -> Parameters:
    """The parameters that training starts from; with a leading axis for a sequence of seeds."""
    if isinstance(seeds, int):
        return jax.jit(model.init)(jax.random.key(seeds))
    return jax.jit(lambda numbers: jax.lax.map(lambda seed: model.init(jax.random.key(seed)), numbers))(
        jnp.asarray(seeds)
    )


def automatic_optimizer(model: Model, sets: Split, objective: Objective = TORQUE) -> tuple[str, str]:
    """The optimiser for a model of this size and data, and why."""
    like = jax.eval_shape(model.init, jax.random.key(0))
    return choose_optimizer(like, len(sets.train.t), len(objective.scale(sets.train)))


def validation_errors(
    model: Model, sets: Split, parameters: Parameters, settings: Settings, objective: Objective = TORQUE
) -> Float[np.ndarray, " N"]:
    """Squared error of each validation sample, whose mean is what selects."""
    dtype = data_type(settings.precision)
    batch, scale = residuals.arrays(objective, sets.validation, dtype), objective.scale(sets.train).astype(dtype)
    return np.asarray(jax.jit(lambda given: _squares(objective, model, given, batch, scale))(parameters))


def _numbers(data: Trajectories, objective: Objective):
    return [getattr(data, key) for key in objective.keys if getattr(data, key) is not None]


def _squares(objective: Objective, model: Model, parameters: Any, batch: tuple[Array, ...], scale: Array) -> Array:
    """Squared error of each sample of a batch, in the units that the objective selects by."""
    errors = residuals.residuals(objective, model.energies(parameters), batch)
    return jnp.sum((errors if objective.selects_by == "torque" else errors / scale) ** 2, axis=1)
