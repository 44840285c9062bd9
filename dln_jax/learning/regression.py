"""Fitting a differential network, or an ensemble of them, to samples of a function and of its derivatives.

Losses: type 1 reads values and Jacobians, type 2 values only (the published names); derivative 2 adds the Hessian to
either. All are means over samples of sums of squares over components, without weights between the terms:

    r = [y_hat - y, dy_hat/dx - dy/dx, d²y_hat/dx² - d²y/dx²],   loss = mean over samples of |r|².

Two optimisers: the published recipe (Adam with decoupled weight decay, minibatches, constant rate) for wide networks,
and Levenberg-Marquardt on all samples at once, float64, for small ones, whose errors go down to what the noise leaves.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Float

from dln_jax.data.functions import FunctionSamples, SampleSplit
from dln_jax.learning import fit, gauss_newton
from dln_jax.learning.train import Progress, Training, data_type
from dln_jax.nn import differential_mlp, ensembles
from dln_jax.nn.activations import Activation, activation
from dln_jax.nn.differential_mlp import Layers
from dln_jax.types import InputError, Scalar, require_positive

LOSSES = ("type1", "type2")
OPTIMIZERS = ("adam", "gauss-newton")


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
    steps: int = 100
    """Iterations of Gauss-Newton for each member, at most."""
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
    numbers = ("width", "depth", "members", "epochs", "batch", "learning_rate", "steps")
    require_positive(**{name: getattr(settings, name) for name in numbers})
    if settings.optimizer not in OPTIMIZERS:
        raise InputError(f"optimizer is '{settings.optimizer}'; expected one of {', '.join(OPTIMIZERS)}")
    if settings.optimizer == "gauss-newton" and settings.precision != "f64":
        raise InputError(f"precision is {settings.precision}; gauss-newton needs f64, as it squares condition numbers")
    activation(settings.activation)
    data_type(settings.precision)
    _needed(data, settings)


def targets(data: FunctionSamples, settings: Settings) -> Targets:
    """The arrays that the loss reads, on the device.

    Raises:
        InputError: an unknown loss or derivative, or a derivative that the data lack.
    """
    dtype = data_type(settings.precision)
    needed = _needed(data, settings)
    return Targets(**{key: jnp.asarray(getattr(data, key), dtype) for key in needed})


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
    sets: SampleSplit, settings: Settings, *, report: Callable[[Progress], None] = lambda progress: None
) -> Training:
    """Fits the training samples and keeps the parameters with the lowest loss on the validation samples.

    The result's parameters are layers with the ensemble's members on the leading axis, also when there is one. Adam
    shows all members the same batches and keeps one step for all; Gauss-Newton keeps the best of each.

    Raises:
        InputError: what `check` finds.
    """
    check(sets.train, settings)
    sizes = (sets.train.inputs, *(settings.width,) * settings.depth, sets.train.outputs)
    layers = ensembles.init(
        jax.random.key(settings.seed), sizes, members=settings.members, dtype=data_type(settings.precision)
    )
    ours, theirs = (targets(data, settings) for data in sets)
    start = _by_adam if settings.optimizer == "adam" else _by_gauss_newton
    return start(layers, ours, theirs, settings, report)


def steps_of(sets: SampleSplit, settings: Settings) -> int:
    """Steps of a whole run, as `report` counts them."""
    if settings.optimizer == "gauss-newton":
        return settings.steps
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


def _by_adam(layers: Layers, train: Targets, validation: Targets, settings: Settings, report) -> Training:
    function = activation(settings.activation)

    def sum_of_losses(layers: Layers, batch: Targets) -> Scalar:
        """A sum, so that each member's gradient, and with it its training, is the same as alone."""
        return jax.vmap(lambda member: mean_loss(member, batch, activation=function))(layers).sum()

    steps = settings.epochs * (len(train.x) // min(settings.batch, len(train.x)))
    prepared = fit.make_fit(
        sum_of_losses,
        optax.adamw(settings.learning_rate, weight_decay=settings.weight_decay),
        train,
        steps=steps,
        batch=settings.batch,
        score=lambda layers: (sum_of_losses(layers, validation) / settings.members, jnp.array(jnp.nan)),
        steps_per_dispatch=max(1, min(450, steps // 20)),
    )
    state = prepared.init(layers, settings.seed)
    start = time.perf_counter()
    compiled = prepared.dispatch.lower(state, prepared.epochs_per_dispatch).compile()
    compile_seconds = time.perf_counter() - start
    start = time.perf_counter()
    history: list[Progress] = []

    def on_dispatch(state: fit.FitState, record: fit.Record) -> None:
        record = record._replace(loss=record.loss / settings.members)
        history.append(Progress(*record, seconds=time.perf_counter() - start))
        report(history[-1])

    state, stop = fit.run(prepared._replace(dispatch=compiled), state, patience=steps, on_dispatch=on_dispatch)
    return Training(state.best_parameters, history, stop, int(state.best_step), compile_seconds)


def _by_gauss_newton(layers: Layers, train: Targets, validation: Targets, settings: Settings, report) -> Training:
    function = activation(settings.activation)
    keys = [key for key, array in train._asdict().items() if array is not None]

    def sample_residual(layers: Layers, *sample: Array) -> Array:
        return residual(layers, Targets(**dict(zip(keys, sample, strict=True))), activation=function)

    optimiser = gauss_newton.make_levenberg_marquardt(
        sample_residual, improvement_tolerance=settings.improvement_tolerance
    )
    history: list[Progress] = []

    def on_progress(at: gauss_newton.Progress) -> None:
        value = float("nan") if at.validation is None else float(at.validation.mean())
        step = int(at.iteration.max())
        history.append(Progress(step, float(at.loss.mean()), value, monitor=float("nan"), seconds=at.seconds))
        report(history[-1])

    result = gauss_newton.minimise(
        optimiser,
        jax.vmap(lambda member: optimiser.init(member))(layers),
        tuple(getattr(train, key) for key in keys),
        iterations=settings.steps,
        validation=lambda member: mean_loss(member, validation, activation=function),
        report=on_progress,
    )
    compile_seconds = result.statistics.compile_seconds
    history = [at._replace(seconds=at.seconds - compile_seconds) for at in history]
    failed = (result.status == gauss_newton.Status.NON_FINITE).any()
    stop = fit.Stop("not finite" if failed else "finished", int(result.statistics.iterations.max()))
    best = min(history, key=lambda at: at.validation, default=None)
    return Training(result.parameters, history, stop, 0 if best is None else int(best.step), compile_seconds)
