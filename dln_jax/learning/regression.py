"""Fitting a differential network, or an ensemble of them, to samples of a function and of its derivatives.

Losses: type 1 reads values and Jacobians, type 2 values only (the published names); derivative 2 adds the Hessian to
either. All are means over samples of sums of squares over components, without weights between the terms:

    r = [y_hat - y, dy_hat/dx - dy/dx, d²y_hat/dx² - d²y/dx²],   loss = mean over samples of |r|².

Two optimisers: the published recipe (Adam with decoupled weight decay, minibatches, constant rate) for wide networks,
and Levenberg-Marquardt on all samples at once, float64, for small ones, whose errors go down to what the noise leaves.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jaxtyping import Float

from dln_jax.data.functions import FunctionSamples, SampleSplit
from dln_jax.data.magnitudes import on_device
from dln_jax.learning.engine.first_order import train_first_order
from dln_jax.learning.engine.optimisers import check_adamw
from dln_jax.learning.engine.runs import Checkpoint, Progress, Report, Training, require_start, silent
from dln_jax.learning.engine.second_order import COARSE_SAMPLES, Budget, train_second_order
from dln_jax.learning.growth import Trial, grow
from dln_jax.nn import differential_mlp, ensembles
from dln_jax.nn.activations import Activation, activation
from dln_jax.nn.differential_mlp import Layers
from dln_jax.precision import data_type, require_float64
from dln_jax.types import InputError, Scalar, require_network, require_positive, require_seed

LOSSES = ("type1", "type2")
OPTIMIZERS = ("adam", "gauss-newton")
WIDTHS = (2, 4, 8, 16)
"""Of hidden layers, for `grow_width`."""


class Settings(NamedTuple):
    """How to train; the defaults are the published recipe."""

    loss: str = "type1"
    """type1 or type2."""
    derivative: int = 1
    """2 adds the Hessian to the loss."""
    activation: str = "cos"
    width: int = 128
    depth: int = 1
    """Hidden layers."""
    members: int = 1
    """Networks of the ensemble, which differ in their initial parameters."""
    optimizer: str = "adam"
    """adam or gauss-newton."""
    epochs: int = 500
    """Of Adam."""
    batch: int = 512
    learning_rate: float = 1e-3
    weight_decay: float = 1e-6
    steps: int = 40
    """Iterations of Gauss-Newton on all samples for each member, at most."""
    coarse_steps: int = 200
    """Iterations of Gauss-Newton before, at most, on a part of the samples, where there are many."""
    improvement_tolerance: float = 1e-7
    """Relative decrease of the loss in an iteration of Gauss-Newton at which a member stops."""
    precision: str = "f32"
    """f32 or f64; Gauss-Newton needs f64."""
    seed: int = 0


class Targets(NamedTuple):
    """What a loss reads, samples on axis 0; `None` is what it does not read, and is never computed."""

    x: Array
    """[N, n]"""
    y: Array
    """[N, m]"""
    dy: Array | None = None
    """[N, m, n]"""
    d2y: Array | None = None
    """[N, m, n, n]"""


def check(data: FunctionSamples, settings: Settings) -> None:
    """Raises `InputError` if the settings are out of range, or the data lack a derivative that the loss reads."""
    numbers = ("width", "depth", "members", "epochs", "batch", "steps")
    require_positive(**{name: getattr(settings, name) for name in numbers})
    check_adamw(learning_rate=settings.learning_rate, weight_decay=settings.weight_decay)
    require_seed(settings.seed)
    if settings.coarse_steps < 0:
        raise InputError(f"coarse_steps is {settings.coarse_steps}; expected a number of iterations, or 0 for none")
    if settings.optimizer not in OPTIMIZERS:
        raise InputError(f"optimizer is '{settings.optimizer}'; expected one of {', '.join(OPTIMIZERS)}")
    if settings.optimizer == "gauss-newton":
        require_float64(settings.precision)
    require_network(width=settings.width, depth=settings.depth)
    activation(settings.activation)
    targets(data, settings)


def targets(data: FunctionSamples, settings: Settings) -> Targets:
    """The arrays that the loss reads, on the device.

    Raises:
        InputError: an unknown loss or derivative, a derivative that the data lack, or numbers whose squares overflow.
    """
    dtype = data_type(settings.precision)
    needed = _needed(data, settings)
    return Targets(**{key: on_device(key, getattr(data, key), dtype) for key in needed})


def residual(layers: Layers, sample: Targets, *, activation: Activation) -> Float[Array, "r"]:
    """r of one sample, as far as the sample has targets: value, Jacobian and Hessian, flat, one after the other."""
    if sample.d2y is not None:
        predicted = differential_mlp.value_jacobian_and_hessian(layers, sample.x, activation=activation)
    elif sample.dy is not None:
        predicted = differential_mlp.value_and_jacobian(layers, sample.x, activation=activation)
    else:
        predicted = (differential_mlp.value(layers, sample.x, activation=activation),)
    pairs = zip(predicted, sample[1:], strict=False)
    return jnp.concatenate([(ours - theirs).ravel() for ours, theirs in pairs if theirs is not None])


def mean_loss(layers: Layers, batch: Targets, *, activation: Activation) -> Scalar:
    """Mean over samples of |r|²."""
    residuals = jax.vmap(lambda sample: residual(layers, sample, activation=activation))(batch)
    return jnp.mean(jnp.sum(residuals**2, axis=-1))


def train(
    sets: SampleSplit, settings: Settings, *, checkpoint: Checkpoint | None = None, report: Report = silent
) -> Training:
    """Fits the training samples and keeps the parameters with the lowest loss on the validation samples.

    The result's parameters are layers with the ensemble's members on the leading axis, also when there is one. Adam
    shows all members the same batches and keeps one step for all; Gauss-Newton keeps the best of each.

    Args:
        sets: what to fit, and to select by.
        settings: how to train.
        checkpoint: where to store the run after every dispatch, and whether to continue one.
        report: called after every dispatch, with means over the members.

    Raises:
        InputError: what `check` finds, a loss that is not finite to begin with, or a checkpoint that does not fit.
    """
    check(sets.train, settings)
    sizes = (sets.train.inputs, *(settings.width,) * settings.depth, sets.train.outputs)
    layers = ensembles.init(
        jax.random.key(settings.seed), sizes, members=settings.members, dtype=data_type(settings.precision)
    )
    ours, theirs = (targets(data, settings) for data in sets)
    start = _by_adam if settings.optimizer == "adam" else _by_gauss_newton
    return require_start(start(layers, ours, theirs, settings, checkpoint, report))


def steps_of(sets: SampleSplit, settings: Settings) -> int:
    """Steps of a whole run, as `report` counts them."""
    if settings.optimizer == "gauss-newton":
        return settings.steps + (settings.coarse_steps if len(sets.train.x) >= 2 * COARSE_SAMPLES else 0)
    samples = len(sets.train.x)
    return settings.epochs * (samples // min(settings.batch, samples))


def _needed(data: FunctionSamples, settings: Settings) -> list[str]:
    """Keys of the data that the loss reads."""
    if settings.loss not in LOSSES:
        raise InputError(f"loss is '{settings.loss}'; expected one of {', '.join(LOSSES)}")
    if settings.derivative not in (1, 2):
        raise InputError(f"derivative is {settings.derivative}; expected 1, or 2 to fit the Hessian too")
    needed = ["x", "y"]
    if settings.loss == "type1":
        if data.dy is None:
            raise InputError("type1 fits the gradient, but the data have no dy; add it or choose type2")
        needed.append("dy")
    if settings.derivative == 2:
        if data.d2y is None:
            raise InputError("derivative 2 fits the Hessian, but the data have no d2y; add it or choose derivative 1")
        needed.append("d2y")
    return needed


def _by_adam(
    layers: Layers,
    train: Targets,
    validation: Targets,
    settings: Settings,
    checkpoint: Checkpoint | None,
    report: Report,
) -> Training:
    function = activation(settings.activation)

    def sum_of_losses(layers: Layers, batch: Targets) -> Scalar:
        """A sum, so that each member's gradient, and with it its training, is the same as alone."""
        if settings.members == 1:
            # An axis of one member would make every product a batch of products, at two or three times the cost.
            return mean_loss(jax.tree.map(lambda leaf: leaf[0], layers), batch, activation=function)
        return jax.vmap(lambda member: mean_loss(member, batch, activation=function))(layers).sum()

    steps = settings.epochs * (len(train.x) // min(settings.batch, len(train.x)))
    training = train_first_order(
        sum_of_losses,
        optax.adamw(settings.learning_rate, weight_decay=settings.weight_decay),
        layers,
        train,
        score=lambda layers: (sum_of_losses(layers, validation) / settings.members, jnp.array(jnp.nan)),
        seed=settings.seed,
        steps=steps,
        batch=settings.batch,
        patience=steps,
        steps_per_dispatch=max(1, min(450, steps // 20)),
        checkpoint=checkpoint,
        report=lambda at: report(_per_member(at, settings)),
    )
    return training._replace(history=[_per_member(at, settings) for at in training.history])


def _per_member(at: Progress, settings: Settings) -> Progress:
    return at._replace(loss=at.loss / settings.members)


def _by_gauss_newton(
    layers: Layers,
    train: Targets,
    validation: Targets,
    settings: Settings,
    checkpoint: Checkpoint | None,
    report: Report,
) -> Training:
    function = activation(settings.activation)
    keys = [key for key, array in train._asdict().items() if array is not None]

    def sample_residual(layers: Layers, *sample: Array) -> Array:
        return residual(layers, Targets(**dict(zip(keys, sample, strict=True))), activation=function)

    def mean_over_members(at: Progress) -> Progress:
        return at._replace(loss=np.mean(at.loss), validation=np.mean(at.validation), monitor=float("nan"))

    training = train_second_order(
        sample_residual,
        layers,
        tuple(getattr(train, key) for key in keys),
        score=lambda member: (mean_loss(member, validation, activation=function), jnp.array(jnp.nan)),
        budget=Budget(settings.steps, settings.coarse_steps, improvement_tolerance=settings.improvement_tolerance),
        seeds=True,
        checkpoint=checkpoint,
        report=lambda at: report(mean_over_members(at)),
    )
    history = [mean_over_members(at) for at in training.history]
    return training._replace(history=history, best_step=int(np.max(training.best_step)))


def grow_width(
    sets: SampleSplit, settings: Settings, fit: Callable[[Settings], Training], *, widths: Sequence[int] = WIDTHS
) -> tuple[Trial, list[Trial]]:
    """Trains networks of growing width by `fit` and chooses the smallest that the validation calls enough.

    The outcome of each trial is its `Training`.
    """

    def fit_and_judge(candidate: Settings) -> tuple[Training, Float[np.ndarray, " N"]]:
        training = fit(candidate)
        return training, validation_errors(sets, candidate, training.parameters)

    return grow([settings._replace(width=width) for width in widths], fit_and_judge)


def validation_errors(sets: SampleSplit, settings: Settings, layers: Layers) -> Float[np.ndarray, " N"]:
    """|r|² of each validation sample, the mean over the ensemble's members."""
    function = activation(settings.activation)

    @jax.jit
    def squares(batch: Targets) -> Array:
        def of_member(member: Layers) -> Array:
            return jax.vmap(lambda sample: jnp.sum(residual(member, sample, activation=function) ** 2))(batch)

        return jnp.mean(jax.vmap(of_member)(layers), axis=0)

    return np.asarray(squares(targets(sets.validation, settings)))
