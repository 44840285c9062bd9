"""Splits a log into training, validation and test."""

from typing import NamedTuple

import numpy as np

from dln_jax.data.encoders.smoothing import labels_of_parts
from dln_jax.data.log import Log
from dln_jax.data.repeated_motions import motion_numbers, remark_on_repeats
from dln_jax.data.splits import BLOCKS, LEAST_TRAJECTORIES, Split, in_blocks, is_cut, split, stated_test

USES = ("training", "validation", "the test")
"""Uses of the parts of a split, in their order."""


class Parts(NamedTuple):
    """The parts of a log."""

    sets: Split
    blocks: bool = False
    """Whether recordings were cut into blocks of time to have validation and test data."""
    remarks: tuple[str, ...] = ()


def split_log(log: Log, test: str | None = None, *, seed: int = 0) -> Parts:
    """Splits a log by trajectories; recordings of one motion stay together.

    Args:
        log: the log.
        test: comma-separated labels of the test trajectories; "last:30%" for the end of every trajectory; or "blocks"
            for ten blocks of time in each (default: every sixth trajectory, or blocks if there are fewer than three).
        seed: seed of the draw of the validation trajectories.

    Raises:
        InputError: as for `data.splits.stated_test` and `data.splits.split`.
    """
    data, labels = log.data, None
    recordings = len(np.unique(data.trajectory))
    if is_cut(test):
        data, labels = stated_test(data, test)
    elif test:
        labels = [label.strip() for label in test.split(",")]
        labels = labels if log.smoothed is None else labels_of_parts(data, labels)
    elif recordings < LEAST_TRAJECTORIES:
        data = in_blocks(data, BLOCKS)
    blocks = len(np.unique(data.trajectory)) != recordings
    motion = None if blocks else motion_numbers(data.q, data.trajectory)  # blocks of one motion may look alike
    sets = split(data, test=labels, seed=seed, motion=motion)
    remark = remark_on_repeats([sets.train, sets.validation], sets.test, motion)
    remarks = [remark] if remark else []
    if blocks:
        counts = [f"{len(np.unique(part.trajectory))} for {use}" for part, use in zip(sets, USES, strict=True)]
        which = "one recording" if recordings == 1 else f"{recordings} recordings"
        remarks.append(f"{which}: cut into blocks of time, {', '.join(counts)}")
    return Parts(sets, blocks, tuple(remarks))
