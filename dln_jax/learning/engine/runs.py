"""What every training gives, and how a run is stored so that it can continue."""

import hashlib
import math
import reprlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from dln_jax.files import finite, is_file, matches
from dln_jax.types import InputError
from dln_jax.zoo import parameter_files as checkpoints

CHECKPOINT = "checkpoint"
"""Name of the file pair in a run's folder from which it can continue."""

NO_START = "the loss is not finite before training; look for very large numbers in the data"
"""What is refused where a training cannot begin."""


class Progress(NamedTuple):
    """State of a run after a dispatch; numbers, or an array [seeds] where several train together."""

    step: Any
    loss: Any
    validation: Any
    monitor: Any
    """The test error, shown and never used for a choice; NaN where nothing is monitored."""
    seconds: float
    """Training time so far, compilation and interruptions apart."""
    stage: str = ""
    """What is trained at the moment, where a training has several stages."""


class Stop(NamedTuple):
    """Why a run ended."""

    reason: str
    """"finished", "no improvement", "time" or "not finite"."""
    step: int
    """Steps taken; for "not finite" those after which the loss was not."""


class Training(NamedTuple):
    """What a run gives."""

    parameters: Any
    """Those with the lowest validation error; with a leading axis where several seeds trained."""
    history: list[Progress]
    stop: Stop
    best_step: Any
    """Step of the lowest validation; an integer, or an array [seeds]."""
    compile_seconds: float

    @property
    def train_seconds(self) -> float:
        """Training time, compilation apart."""
        return self.history[-1].seconds if self.history else 0.0

    @property
    def validation(self) -> Any:
        """The lowest validation error; inf before the first. A number, or an array [seeds]."""
        values = [at.validation for at in self.history]
        return plain(np.nanmin([np.full_like(values[0], np.inf, float), *values], axis=0)) if values else math.inf


class Checkpoint(NamedTuple):
    """Where a run is stored, and by what it is recognised."""

    directory: Path
    """An existing folder."""
    identity: dict[str, Any]
    """JSON values that decide the result: `settings` and `data`. A run of other values is not continued."""
    resume: bool = False
    """Continue from what is stored, if anything is."""
    name: str = CHECKPOINT


Report = Callable[[Progress], None]


def silent(progress: Progress) -> None:
    """Reports nothing."""


def require_start(training: Training) -> Training:
    """The training; raises `InputError` where its loss was not finite to begin with, so that nothing was learned."""
    if training.stop == Stop("not finite", 0):
        raise InputError(NO_START)
    return training


def one_after_the_other(histories: Iterable[list[Progress]]) -> list[Progress]:
    """The histories of several trainings as one, whose steps and seconds go on."""
    joined: list[Progress] = []
    for history in histories:
        step, seconds = (joined[-1].step, joined[-1].seconds) if joined else (0, 0.0)
        joined += [at._replace(step=step + at.step, seconds=seconds + at.seconds) for at in history]
    return joined


def fingerprint(arrays: Iterable[np.ndarray | None]) -> str:
    """SHA-256 of the numbers that a run reads, by which a resumed run knows its data."""
    digest = hashlib.sha256()
    for array in arrays:
        if array is not None:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def plain(values: Any) -> Any:
    """A scalar as a Python number, an array as a NumPy one."""
    array = np.asarray(values)
    return array if array.ndim else array.item()


def store(checkpoint: Checkpoint, state: Any, history: list[Progress]) -> None:
    """Writes the state of a run and what it has reported so far."""
    facts = {**checkpoint.identity, "history": [[_json(value) for value in row] for row in history]}
    number = int(np.max(history[-1].step)) if history else 0
    checkpoints.save_tree(checkpoint.directory, checkpoint.name, state, facts, number=number)


def restore(checkpoint: Checkpoint | None, like: Any) -> tuple[Any, list[Progress]] | None:
    """The stored state and history, or `None` where a run is to start from the beginning.

    Raises:
        InputError: the stored run had other settings or data, or its files are damaged.
    """
    if checkpoint is None or not checkpoint.resume or not has_checkpoint(checkpoint.directory, checkpoint.name):
        return None
    manifest = checkpoints.load_manifest(checkpoint.directory, checkpoint.name)
    for key, remedy in (("data", "give the data and test labels"), ("settings", "give the settings")):
        if manifest.get(key) != finite(checkpoint.identity.get(key)):
            raise InputError(
                f"{checkpoint.directory}: the run was started with other {key}; {remedy} it was started with"
            )
    state = checkpoints.load_tree(checkpoint.directory, checkpoint.name, like)
    path = checkpoint.directory / f"{checkpoint.name}.json"
    rows = stored_rows(path, manifest, "history", (int, *[float | None] * 3, float, str))
    return state, [Progress(*map(_number, row)) for row in rows]


def stored_rows(path: Path, manifest: dict[str, Any], key: str, types: Sequence[Any]) -> list[list[Any]]:
    """The rows under a key of a manifest, with one JSON value of each of these types; where several seeds trained
    together, a list of them.

    Raises:
        InputError: the manifest has no such rows.
    """
    rows = manifest.get(key)
    if not isinstance(rows, list):
        raise InputError(f"{path}: {key} is {reprlib.repr(rows)}, expected a list; {checkpoints.REMEDY}")
    for row in rows:
        columns = [each if isinstance(each, list) else [each] for each in row] if isinstance(row, list) else []
        right = len(columns) == len(types) and all(
            all(matches(value, hint) for value in column) for column, hint in zip(columns, types, strict=True)
        )
        if not right or [np.shape(each) for each in row] != [np.shape(each) for each in rows[0]]:
            raise InputError(f"{path}: {key} holds {reprlib.repr(row)}, expected numbers; {checkpoints.REMEDY}")
    return rows


def has_checkpoint(directory: Path, name: str = CHECKPOINT) -> bool:
    """Whether a run in this folder got as far as its first checkpoint."""
    return is_file(directory / f"{name}.json")


def _json(value: Any) -> Any:
    """NaN and infinity are no JSON."""
    if isinstance(value, str):
        return value
    if np.ndim(value):
        return [_json(each) for each in value]
    value = plain(value)
    return value if isinstance(value, int) or math.isfinite(value) else None


def _number(value: Any) -> Any:
    if isinstance(value, list):
        return np.array([math.nan if each is None else each for each in value])
    return math.nan if value is None else value


def require_finite_start(loss: Callable[[Any, Any], Array], init: Callable[[Array], Any], seed: int, data: Any) -> None:
    """Raises `InputError` unless `loss(parameters, data)` is finite for what `init` draws by the seed."""
    options = {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else None
    value = jax.jit(lambda key, data: loss(init(key), data), compiler_options=options)(jax.random.key(seed), data)
    if not np.isfinite(value):
        raise InputError(NO_START)
