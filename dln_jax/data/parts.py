"""Splits a log into training, validation and test."""

from typing import NamedTuple

import numpy as np

from dln_jax.data.encoders.smoothing import labels_of_parts
from dln_jax.data.log import Log
from dln_jax.data.repeated_motions import motion_numbers, remark_on_repeats
from dln_jax.data.splits import (
    BLOCKS,
    LEAST_TRAJECTORIES,
    Split,
    by_motion,
    in_blocks,
    is_cut,
    label_indices,
    require_no_copies,
    select,
    split,
    stated_test,
)
from dln_jax.types import InputError

USES = ("training", "validation", "the test")
"""Uses of the parts of a split, in their order."""
HELD_OUT = slice(2, None, 5)
"""Trajectories or blocks held out without validation: the third of every five."""


class Parts(NamedTuple):
    """The parts of a log."""

    sets: Split
    blocks: bool = False
    """Whether recordings were cut into blocks of time to have validation and test data."""
    remarks: tuple[str, ...] = ()


def split_log(log: Log, test: str | None = None, *, seed: int = 0, validation: bool = True) -> Parts:
    """Splits a log by trajectories; recordings of one motion stay together.

    Args:
        log: the log.
        test: comma-separated labels of the test trajectories; "last:30%" for the end of every trajectory; or "blocks"
            for ten blocks of time in each (default: every sixth trajectory, or the third of every five without
            validation; or such blocks if there are too few trajectories).
        seed: seed of the draw of the validation trajectories.
        validation: whether a part is for model selection; otherwise it is empty.

    Raises:
        InputError: as for `data.splits.stated_test` and `data.splits.split`; or no trajectory to fit, or to test by.
    """
    data, labels = stated_test(log.data, test or None)
    recordings = len(np.unique(log.data.trajectory))
    if labels is None and not is_cut(test) and recordings < (LEAST_TRAJECTORIES if validation else 2):
        data = in_blocks(data, BLOCKS)
    elif labels and not is_cut(test) and log.smoothed is not None:
        labels = labels_of_parts(data, labels)
    present = np.unique(data.trajectory)
    blocks = len(present) != recordings
    motion = None if blocks else motion_numbers(data.q, data.trajectory)  # blocks of one motion may look alike
    if validation:
        sets = split(data, test=labels, seed=seed, motion=motion)
    else:
        held = by_motion(present, motion, HELD_OUT, least=2) if labels is None else label_indices(data, labels)
        rest = np.setdiff1d(present, held)
        if not len(rest) or not len(np.intersect1d(held, present)):
            raise InputError("--test leaves no trajectory to fit, or none to judge by; name fewer, or others")
        sets = Split(select(data, rest), select(data, []), select(data, held))
        require_no_copies(sets.train, sets.test)
    remark = remark_on_repeats([sets.train, sets.validation], sets.test, motion)
    remarks = [remark] if remark else []
    if blocks and validation:
        counts = [f"{len(np.unique(part.trajectory))} for {use}" for part, use in zip(sets, USES, strict=True)]
        which = "one recording" if recordings == 1 else f"{recordings} recordings"
        remarks.append(f"{which}: cut into blocks of time, {', '.join(counts)}")
    return Parts(sets, blocks, tuple(remarks))
