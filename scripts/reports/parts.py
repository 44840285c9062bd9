"""Test sets for cross-validation."""

import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.types import InputError


def partition_labels(data: Trajectories, parts: int, *, seed: int = 0) -> list[list[str]]:
    """Labels in groups of nearly equal size for cross-validation: every trajectory is in one test set.

    The sorted labels are permuted by the seed before they are cut, so the order in the file has no influence.

    Raises:
        InputError: fewer than two parts, or more than there are trajectories.
    """
    labels = np.sort(data.label[np.unique(data.trajectory)])
    if not 2 <= parts <= len(labels):
        raise InputError(f"{len(labels)} trajectories cannot be cut into {parts} tests; ask for 2 to {len(labels)}")
    permuted = np.random.default_rng(seed).permutation(labels)
    return [part.tolist() for part in np.array_split(permuted, parts)]
