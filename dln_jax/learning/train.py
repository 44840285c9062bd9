"""Training of a model of dynamics on trajectories: split in, best parameters out, resumable at any dispatch."""

import hashlib
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split
from dln_jax.learning import checkpoints, fit
from dln_jax.learning.optimisers import adamw
from dln_jax.learning.residuals import samples, torque_loss, torque_residuals, torque_scale
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, require_positive

CHECKPOINT = "checkpoint"
"""Name of the file pair in a run's folder from which it can continue."""


class Settings(NamedTuple):
    """How to train; all of it decides the result, none of it where the result goes."""

    steps: int = 20_000
    batch: int = 512
    learning_rate: float = 5e-3
    """Peak, reached after warm-up and followed by cosine decay."""
    weight_decay: float = 1e-5
    patience: int = 10_000
    """Steps without a better validation error after which training stops."""
    precision: str = "f32"
    """f32 or f64."""
    seed: int = 0


class Progress(NamedTuple):
    """State of a run after a dispatch; `monitor` is the test error, shown and never used for a choice."""

    step: float
    loss: float
    validation: float
    monitor: float
    seconds: float
    """Training time so far, compilation and interruptions apart."""


class Training(NamedTuple):
    """What a run gives."""

    parameters: Parameters
    """Those with the lowest validation error."""
    history: list[Progress]
    stop: fit.Stop
    best_step: int
    compile_seconds: float

    @property
    def train_seconds(self) -> float:
        """Training time, compilation apart."""
        return self.history[-1].seconds if self.history else 0.0


def data_type(precision: str) -> Any:
    """float32 or float64, for "f32" or "f64".

    Raises:
        InputError: another name, or f64 while JAX computes in 32 bits.
    """
    kinds = {"f32": jnp.float32, "f64": jnp.float64}
    if precision not in kinds:
        raise InputError(f"precision is '{precision}'; expected f32 or f64")
    if precision == "f64" and not jax.config.read("jax_enable_x64"):
        raise InputError("f64 needs jax.config.update('jax_enable_x64', True) before the first JAX call")
    return kinds[precision]


def check(sets: Split, settings: Settings) -> None:
    """Raises `InputError` if the settings are out of range, or the torques to be fitted do not vary."""
    require_positive(
        steps=settings.steps,
        batch=settings.batch,
        learning_rate=settings.learning_rate,
        patience=settings.patience,
    )
    data_type(settings.precision)
    torque_scale(sets.train)


def train(
    model: Model,
    sets: Split,
    settings: Settings,
    *,
    directory: Path | None = None,
    resume: bool = False,
    report: Callable[[Progress], None] = lambda progress: None,
) -> Training:
    """Fits torques by AdamW, keeping the parameters with the lowest validation torque error.

    Args:
        model: from `dln_jax.models`, its parameters of the type that `settings.precision` names.
        sets: what to fit, to select by, and to monitor.
        settings: how to train.
        directory: existing folder for a checkpoint after every dispatch; `None` for none.
        resume: continue from the checkpoint in that folder, bit for bit as if never interrupted.
        report: called after every dispatch.

    Raises:
        InputError: what `check` finds, or a checkpoint that does not fit.
    """
    check(sets, settings)
    dtype = data_type(settings.precision)
    scale = torque_scale(sets.train).astype(dtype)
    fitted, selected_by, monitored = (samples(data, dtype) for data in sets)
    held_out = jax.tree.map(lambda *arrays: jnp.concatenate(arrays), selected_by, monitored)

    def score(parameters: Parameters) -> tuple[jax.Array, jax.Array]:
        squares = jnp.sum(torque_residuals(model.apply(parameters), held_out, jnp.ones_like(scale)) ** 2, axis=1)
        return squares[: len(selected_by.q)].mean(), squares[len(selected_by.q) :].mean()

    prepared = fit.make_fit(
        lambda parameters, batch: torque_loss(model.apply(parameters), batch, scale),
        adamw(steps=settings.steps, learning_rate=settings.learning_rate, weight_decay=settings.weight_decay),
        fitted,
        steps=settings.steps,
        batch=settings.batch,
        score=score,
    )
    identity = {"settings": settings._asdict(), "data": fingerprint(sets)}
    state = prepared.init(jax.jit(model.init)(jax.random.key(settings.seed)), settings.seed)
    history: list[Progress] = []
    if resume and directory is not None:
        state, history = _restore(directory, state, identity)

    start = time.perf_counter()
    compiled = prepared.dispatch.lower(state, prepared.epochs_per_dispatch).compile()
    compile_seconds = time.perf_counter() - start

    earlier = history[-1].seconds if history else 0.0
    start = time.perf_counter()
    storing = 0.0

    def on_dispatch(state: fit.FitState, record: fit.Record) -> None:
        nonlocal storing
        history.append(Progress(*record, seconds=earlier + time.perf_counter() - start - storing))
        began = time.perf_counter()
        if directory is not None:
            # NaN is no JSON.
            facts = {**identity, "history": [[None if math.isnan(x) else x for x in row] for row in history]}
            checkpoints.save_tree(directory, CHECKPOINT, state, facts, number=record.step)
        report(history[-1])
        storing += time.perf_counter() - began

    state, stop = fit.run(
        prepared._replace(dispatch=compiled), state, patience=settings.patience, on_dispatch=on_dispatch
    )
    return Training(state.best_parameters, history, stop, int(state.best_step), compile_seconds)


def has_checkpoint(directory: Path) -> bool:
    """Whether a run in this folder got as far as its first checkpoint."""
    return (directory / f"{CHECKPOINT}.json").is_file()


def fingerprint(sets: Split) -> str:
    """SHA-256 of the numbers that a run reads, by which a resumed run knows its data."""
    digest = hashlib.sha256()
    for data in sets:
        for array in _numbers(data):
            digest.update(array.tobytes())
    return digest.hexdigest()


def _numbers(data: Trajectories):
    return (data.q, data.qd, data.qdd, data.tau)


def _restore(directory: Path, like: fit.FitState, identity: dict[str, Any]) -> tuple[fit.FitState, list[Progress]]:
    manifest = checkpoints.load_manifest(directory, CHECKPOINT)
    for key, remedy in (("data", "give the data and test labels"), ("settings", "give the settings")):
        if manifest.get(key) != identity[key]:
            raise InputError(f"{directory}: the run was started with other {key}; {remedy} it was started with")
    state = checkpoints.load_tree(directory, CHECKPOINT, like)
    history = [Progress(*(math.nan if value is None else value for value in row)) for row in manifest["history"]]
    return state, history
