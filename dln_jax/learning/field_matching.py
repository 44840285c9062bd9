"""Derivative matching: a phase field is fitted to measured rates (qd, pd) of states (q, p).

    loss = mean over samples and components of |rates(q, p) - (qd, pd)|²

the published loss of Hamiltonian networks (Greydanus, Dzamba and Yosinski 2019). By Gauss-Newton, Adam, or, for a
field that is linear in its parameters, by one least-squares problem. The parameters kept are those with the lowest
loss on validation trajectories, which are drawn from those for training; no test is looked at.

Where states carry noise and rates do not, the loss has a bias that more data do not remove: it flattens the field
(regression dilution). `learning.trajectory_matching` has not.
"""

import functools
import math
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.data.magnitudes import on_device
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select
from dln_jax.learning.engine.first_order import train_first_order
from dln_jax.learning.engine.optimisers import adamw, check_adamw
from dln_jax.learning.engine.runs import (
    Checkpoint,
    Progress,
    Report,
    Stop,
    Training,
    require_finite_start,
    require_start,
    silent,
)
from dln_jax.learning.engine.second_order import Budget, train_second_order
from dln_jax.mechanics.equations import flow
from dln_jax.models.model import Model, Parameters
from dln_jax.precision import data_type, require_float64
from dln_jax.solvers import least_squares
from dln_jax.types import InputError, Scalar, require_positive, require_seed

FIELD = ("q", "p", "qd", "pd")
"""Arrays that a fit reads."""
OPTIMIZERS = ("adam", "gauss-newton")


class Settings(NamedTuple):
    """How to fit."""

    optimizer: str = "gauss-newton"
    """gauss-newton (Levenberg-Marquardt, f64) or adam."""
    precision: str = "f64"
    """f32 or f64; gauss-newton needs f64."""
    steps: int = 100
    """Iterations of Gauss-Newton, or steps of Adam."""
    samples: int = 10_000
    """Samples to fit, drawn from the training trajectories where those have more."""
    seconds: float = math.inf
    """After which to stop, compilation included; looked at between dispatches, of which there is one at least."""
    batch: int = 512
    """Of Adam, like the learning rate."""
    learning_rate: float = 5e-3
    validation_share: float = 0.1
    """Of the training trajectories, held out to select by."""
    seed: int = 0
    """Of the initial parameters, the held-out trajectories and the order of the samples."""


def hold_out(data: Trajectories, share: float, seed: int) -> tuple[Trajectories, Trajectories]:
    """Training and validation trajectories, at least one of each.

    Raises:
        InputError: fewer than two trajectories, a share outside (0, 1), or a seed out of range.
    """
    require_seed(seed)
    present = np.unique(data.trajectory)
    if len(present) < 2:
        raise InputError(f"there are {len(present)} trajectories for training; expected at least 2, one to validate by")
    if not 0 < share < 1:
        raise InputError(f"validation_share is {share}; expected a number between 0 and 1")
    count = min(max(1, round(share * len(present))), len(present) - 1)
    held_out = np.random.default_rng(seed).choice(present, size=count, replace=False)
    return select(data, np.setdiff1d(present, held_out)), select(data, held_out)


def residual(model: Model, parameters: Parameters, q: Array, p: Array, qd: Array, pd: Array) -> Array:
    """(rates - (qd, pd)) / sqrt(2 d) of one sample [2 d], whose sum of squares is the sample's part of the loss."""
    velocity, force = flow(model.energies(parameters)).rates(q, p)
    return jnp.concatenate([velocity - qd, force - pd]) / math.sqrt(2 * q.shape[0])


def loss(model: Model, parameters: Parameters, arrays: tuple[Array, ...]) -> Scalar:
    """Mean square of rates - (qd, pd) over samples and components; arrays are q, p, qd, pd, [N, d] each."""
    each = jax.vmap(functools.partial(residual, model, parameters))(*arrays)
    return jnp.mean(jnp.sum(each**2, axis=1))


def check(data: Trajectories, settings: Settings) -> None:
    """Raises `InputError` for settings out of range, and for data that no field can be fitted to."""
    require_positive(**{name: getattr(settings, name) for name in ("steps", "samples", "seconds", "batch")})
    check_adamw(learning_rate=settings.learning_rate)
    if settings.optimizer not in OPTIMIZERS:
        raise InputError(f"optimizer is '{settings.optimizer}'; expected one of {', '.join(OPTIMIZERS)}")
    dtype = data_type(settings.precision)
    if settings.optimizer == "gauss-newton":
        require_float64(settings.precision)
    for part in hold_out(data, settings.validation_share, settings.seed):
        samples(part, settings, dtype)


def check_start(model: Model, data: Trajectories, settings: Settings) -> None:
    """Raises `InputError` if the loss is not finite where training starts; takes a compilation."""
    arrays = samples(data, settings._replace(samples=len(data.t)), data_type(settings.precision))
    require_finite_start(functools.partial(loss, model), model.init, settings.seed, arrays)


def match_field(
    model: Model,
    data: Trajectories,
    settings: Settings,
    *,
    checkpoint: Checkpoint | None = None,
    report: Report = silent,
) -> Training:
    """Fits a model to the rates of the training trajectories.

    Args:
        model: a phase model.
        data: with p and pd; some of the trajectories are held out to select by.
        settings: how to fit.
        checkpoint: where to store the run after every dispatch, and whether to continue one.
        report: called after every dispatch.

    Raises:
        InputError: what `check` finds, a loss that is not finite to begin with, or a checkpoint that does not fit.
    """
    check(data, settings)
    dtype = data_type(settings.precision)
    train, validation = hold_out(data, settings.validation_share, settings.seed)
    fitted, held_out = (samples(part, settings, dtype) for part in (train, validation))

    def score(parameters: Parameters) -> tuple[Scalar, Scalar]:
        return loss(model, parameters, held_out), jnp.full((), jnp.nan)

    parameters = jax.jit(model.init)(jax.random.key(settings.seed))
    if settings.optimizer == "gauss-newton":
        trained = train_second_order(
            functools.partial(residual, model),
            parameters,
            fitted,
            score=score,
            budget=Budget(settings.steps, seconds=settings.seconds),
            checkpoint=checkpoint,
            report=report,
        )
        return require_start(trained)
    trained = train_first_order(
        functools.partial(loss, model),
        adamw(steps=settings.steps, learning_rate=settings.learning_rate),
        parameters,
        fitted,
        score=score,
        seed=settings.seed,
        steps=settings.steps,
        batch=min(settings.batch, len(fitted[0])),
        patience=settings.steps,
        seconds=settings.seconds,
        checkpoint=checkpoint,
        report=report,
    )
    return require_start(trained)


def match_linear(
    model: Model, data: Trajectories, *, validation: Trajectories | None = None
) -> tuple[Training, Float[np.ndarray, " N"]]:
    """The least-squares fit of a field that is linear in its parameters, and the squared errors of the validation.

    In float64; the errors are of each sample, and those of the fitted samples without a validation.

    Raises:
        InputError: no p or pd in the data, or numbers that are not finite or whose squares are not.
    """
    began = time.perf_counter()
    with jax.enable_x64(True):
        zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), jax.eval_shape(model.init, jax.random.key(0)))
        columns = jax.jit(jax.jacrev(lambda c, *sample: residual(model, c, *sample)))
        arrays = _in_float64(data)
        design = np.asarray(jax.jit(jax.vmap(columns, in_axes=(None, 0, 0, 0, 0)))(zero, *arrays))
        target = -np.asarray(jax.jit(jax.vmap(functools.partial(residual, model, zero)))(*arrays))
        found = least_squares.solve(design.reshape(-1, design.shape[-1]), target.ravel())
        seconds = time.perf_counter() - began
        judged = arrays if validation is None else _in_float64(validation)
        errors = jax.vmap(functools.partial(residual, model, jnp.asarray(found.x)))(*judged)
        squares = np.sum(np.asarray(errors) ** 2, axis=1)
    fitted = found.residual**2 / len(arrays[0])
    at = Progress(1, fitted, float(squares.mean()), float("nan"), seconds)
    return Training(jnp.asarray(found.x), [at], Stop("finished", 1), 1, 0.0), squares


def samples(data: Trajectories, settings: Settings, dtype: Any) -> tuple[Array, ...]:
    """q, p, qd, pd of at most `settings.samples` samples in random order."""
    chosen = np.random.default_rng(settings.seed).permutation(len(data.t))[: settings.samples]
    return tuple(on_device(name, array[chosen], dtype) for name, array in zip(FIELD, _arrays(data), strict=True))


def _in_float64(data: Trajectories) -> tuple[Array, ...]:
    return tuple(on_device(name, array, jnp.float64) for name, array in zip(FIELD, _arrays(data), strict=True))


def _arrays(data: Trajectories) -> tuple[np.ndarray, ...]:
    if data.p is None or data.pd is None:
        raise InputError("the data have no p and pd, which a field is fitted to; add them, or match trajectories")
    return data.q, data.p, data.qd, data.pd
