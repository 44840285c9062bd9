"""Context of a fit within its run, and checkpoints for resuming a training."""

import hashlib
import math
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from jax import Array
from jax.sharding import Mesh

from dln_jax.files import finite, is_file
from dln_jax.learning.engine.optimisers import Optimiser
from dln_jax.learning.engine.problem import Progress, plain
from dln_jax.process import seconds_left
from dln_jax.types import InputError
from dln_jax.zoo import parameter_files as checkpoints

Number = float | None
Row = tuple[int | list[int], *[Number | list[Number]] * 3, float, str]  # type: ignore[valid-type]
"""A stored `Progress`: `null` for NaN, and lists if several seeds trained together."""
CHECKPOINT = "checkpoint"
"""Stem of the two checkpoint files in a run folder."""


class Checkpoint(NamedTuple):
    """Folder and identity of a stored run."""

    directory: Path
    """An existing folder."""
    identity: dict[str, Any]
    """JSON values that affect the result: `settings` and `data`. A run with other values is not resumed."""
    resume: bool = False
    """Continue from the stored run, if there is one."""
    name: str = CHECKPOINT


@contextmanager
def no_progress(total: int) -> Iterator[Callable[[int, str], None]]:
    """Yields a silent `show(done, text)`."""
    yield lambda done, text: None


class Context(NamedTuple):
    """Context of a fit within its run; by default nothing is printed or stored."""

    seed: int = 0
    """Seed for parameters and shuffling."""
    until: float = math.inf
    """Reading of `time.perf_counter` at which a fit stops."""
    say: Callable[[str], None] = lambda line: None
    """Takes lines for the user."""
    progress: Callable[[int], AbstractContextManager[Callable[[int, str], None]]] = no_progress
    """Total number of steps -> context of `show(done, text)`."""
    folder: Path | None = None
    """Folder of checkpoints and candidates."""
    resume: bool = False
    """Continue from the checkpoints in the folder."""
    mesh: Mesh | None = None
    """Devices that share a fit."""

    @property
    def seconds(self) -> float:
        """Seconds left for the fit."""
        return seconds_left(self.until)

    def within(self, seconds: float) -> "Context":
        """Returns the context of a fit with this time limit."""
        return self._replace(until=min(self.until, time.perf_counter() + seconds))

    def checkpoint(
        self, name: str, optimiser: Optimiser, arrays: Iterable[np.ndarray | Array | None], **settings: Any
    ) -> Checkpoint | None:
        """Returns the checkpoint of a training with this identity; `None` without a folder."""
        if self.folder is None:
            return None
        return Checkpoint(self.folder, identity(optimiser, arrays, **settings), self.resume, name)


def identity(optimiser: Optimiser, arrays: Iterable[np.ndarray | Array | None], **settings: Any) -> dict[str, Any]:
    """Returns the identity of a run: optimiser, settings and the SHA-256 of its arrays, but no time limit."""
    stated = {"optimiser": type(optimiser).__name__, **optimiser._asdict(), **settings}
    data = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays if array is not None)
    return {"settings": stated, "data": hashlib.sha256(data).hexdigest()}


def store(checkpoint: Checkpoint, state: Any, history: list[Progress]) -> None:
    """Writes the state and history of a run."""
    facts = {
        **checkpoint.identity,
        "history": finite([[np.asarray(value).tolist() for value in row] for row in history]),
    }
    number = int(np.max(history[-1].step)) if history else 0
    checkpoints.save_tree(checkpoint.directory, checkpoint.name, state, facts, number=number)


def restore(checkpoint: Checkpoint | None, like: Any) -> tuple[Any, list[Progress]] | None:
    """Returns the stored state and history, or `None` to start from the beginning.

    Raises:
        InputError: the stored run had other settings or data, or its files are damaged.
    """
    if checkpoint is None or not checkpoint.resume or not has_checkpoint(checkpoint.directory, checkpoint.name):
        return None
    manifest = checkpoints.load_manifest(checkpoint.directory, checkpoint.name)
    for key, remedy in (("data", "use the data and test labels"), ("settings", "use the settings")):
        if manifest.get(key) != finite(checkpoint.identity.get(key)):
            raise InputError(f"{checkpoint.directory}: the run was started with other {key}; {remedy} of its start")
    state = checkpoints.load_tree(checkpoint.directory, checkpoint.name, like)
    path = checkpoint.directory / f"{checkpoint.name}.json"
    rows = stored_rows(path, manifest, "history", Row)
    return state, [
        Progress._make([plain(step), *(plain(np.array(value, float)) for value in values), seconds, stage])
        for step, *values, seconds, stage in rows
    ]


def stored_rows(path: Path, manifest: dict[str, Any], key: str, row: Any) -> list[Any]:
    """Returns the rows under a key of a manifest.

    Args:
        row: type of a row, such as `tuple[int, float | None]`.

    Raises:
        InputError: the rows are missing, or the values of one column have different shapes.
    """
    try:
        rows = msgspec.convert(manifest.get(key), list[row])
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {key} is damaged ({error}); {checkpoints.REMEDY}") from error
    if len({tuple(map(np.shape, values)) for values in rows}) > 1:
        raise InputError(f"{path}: {key} has rows of different shapes; {checkpoints.REMEDY}")
    return rows


def has_checkpoint(directory: Path, name: str = CHECKPOINT) -> bool:
    """Whether the folder has a checkpoint of a run."""
    return is_file(directory / f"{name}.json")
