"""What a fit needs of the run that it belongs to: seed, time, output, checkpoints and devices."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from jax.sharding import Mesh

from dln_jax.learning.engine.checkpoint import CHECKPOINT, Checkpoint
from dln_jax.process import seconds_left


@contextmanager
def no_progress(total: int) -> Iterator[Callable[[int, str], None]]:
    """Yields a `show(done, text)` that shows nothing."""
    yield lambda done, text: None


class Context(NamedTuple):
    """The run of a fit; by default none: nothing is printed or stored."""

    seed: int = 0
    """Seed of parameters and shuffling."""
    until: float = math.inf
    """Reading of `time.perf_counter` at which a fit stops."""
    say: Callable[[str], None] = lambda line: None
    """Takes lines for the user."""
    progress: Callable[[int], AbstractContextManager[Callable[[int, str], None]]] = no_progress
    """Total -> context of `show(done, text)`."""
    folder: Path | None = None
    """Folder of checkpoints and candidates."""
    resume: bool = False
    """Continue from what the folder holds."""
    mesh: Mesh | None = None
    """Devices that share a fit."""

    @property
    def seconds(self) -> float:
        """Seconds left for fits."""
        return seconds_left(self.until)

    def within(self, seconds: float) -> "Context":
        """The context of a fit that has at most these seconds."""
        return self._replace(until=min(self.until, time.perf_counter() + seconds))

    def checkpoint(self, identity: dict[str, Any], name: str = CHECKPOINT) -> Checkpoint | None:
        """Where a training with this identity is stored; `None` without a folder."""
        return None if self.folder is None else Checkpoint(self.folder, identity, self.resume, name)
