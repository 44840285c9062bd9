"""The data of the arm: published letters, and random states with the published test motions."""

from pathlib import Path

import numpy as np

from dln_jax.data import schema
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split, select, split
from dln_jax.datasets import generators
from dln_jax.datasets.default_data import CHARACTERS_TEST, default_data
from dln_jax.datasets.generators import uniform_tests
from dln_jax.scenes.two_link_arm import two_link_arm
from dln_jax.types import InputError


def letters(path: Path | None) -> Trajectories:
    """What the arm writes."""
    return _of_the_arm(path, default_data(two_link_arm()) if path is None else schema.load(path))


def published_split(written: Trajectories) -> Split:
    """Letters with the published ones as the test."""
    return split(written, test=CHARACTERS_TEST)


def states(path: Path | None, *, samples: int = 3_000, validation: int = 300) -> Split:
    """Random states of the arm for training, the published free swings for the test."""
    data = _of_the_arm(path, generators.uniform(two_link_arm(), samples=samples) if path is None else schema.load(path))
    present = np.random.default_rng(0).permutation(np.unique(data.trajectory))
    held_out = present[: min(validation, max(1, len(present) // 10))]
    return Split(select(data, np.setdiff1d(present, held_out)), select(data, held_out), uniform_tests())


def _of_the_arm(path: Path | None, data: Trajectories) -> Trajectories:
    if data.degrees_of_freedom != 2:
        raise InputError(f"{path} has {data.degrees_of_freedom} coordinates; the table is that of the two-link arm")
    return data._replace(needs=two_link_arm().needs)
