"""Stores the states of fitted value iterations, one per seed, so that a run continues bit for bit."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dln_jax.control.optimal.fitted import IterationState, ValueProgress
from dln_jax.files import finite, is_file
from dln_jax.learning.engine.checkpoint import stored_rows
from dln_jax.types import InputError
from dln_jax.zoo.parameter_files import load_manifest, load_tree, save_tree

CHECKPOINT = "checkpoint_seed_{}"
"""Stem of the pair of files that holds the state of a seed's iterations."""


class Kept(NamedTuple):
    """Where the states of a training are stored."""

    folder: Path
    settings: Any
    """JSON values that decide the result; a run with others is not continued."""
    resume: bool

    def store(self, seed: int, state: IterationState) -> None:
        """Writes the state of a seed, for `restore`."""
        tree = {"parameters": state.parameters, "optimiser": state.optimiser, "best": state.best}
        facts = {"settings": finite(self.settings), "history": finite([list(at) for at in state.history])}
        save_tree(self.folder, CHECKPOINT.format(seed), tree, facts, number=len(state.history))

    def restore(self, seed: int, state: IterationState) -> IterationState:
        """The stored state of a seed, or the one that it would start with.

        Raises:
            InputError: the stored run had other settings, or its files are damaged.
        """
        name = CHECKPOINT.format(seed)
        if not (self.resume and is_file(self.folder / f"{name}.json")):
            return state
        manifest = load_manifest(self.folder, name)
        if manifest.get("settings") != finite(self.settings):
            raise InputError(f"{self.folder}: the run had another plant or other settings; start a new one")
        like = {"parameters": state.parameters, "optimiser": state.optimiser, "best": state.best}
        kind = tuple[int, float | None, float | None, float]
        rows = stored_rows(self.folder / f"{name}.json", manifest, "history", kind)
        numbers = [[np.nan if number is None else number for number in row] for row in rows]
        history = [ValueProgress(int(k), loss, score, seconds) for k, loss, score, seconds in numbers]
        return IterationState(**load_tree(self.folder, name, like), history=history)
