"""Held-out motions as a user states them: labels, the last part of every trajectory, or blocks of time."""

import re

import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import BLOCKS, in_blocks
from dln_jax.types import InputError

LAST = re.compile(r"last:\s*([\d.]+)\s*%")
ALL_IN_BLOCKS = "blocks"


def is_cut(text: str | None) -> bool:
    """Whether a text asks for parts of trajectories rather than naming some."""
    return text is not None and (text.startswith("last:") or text == ALL_IN_BLOCKS)


def stated_test(data: Trajectories, text: str | None) -> tuple[Trajectories, list[str] | None]:
    """The data cut as the text asks, and the labels of the test; `None` leaves the choice to the split.

    `last:30%` holds out the last 30 % of the samples of every trajectory, as "LABEL[last]". `blocks` cuts every
    trajectory into ten blocks of time. Anything else is a list of labels. A single trajectory is cut into blocks before
    its last part, so that there is something to validate by.

    Raises:
        InputError: a share that is not a percentage between 1 and 90, or a trajectory that is too short for it.
    """
    if not is_cut(text) or text is None:
        return data, None if text is None else [label.strip() for label in text.split(",")]
    if text == ALL_IN_BLOCKS:
        return in_blocks(data, BLOCKS), None
    stated = LAST.fullmatch(text)
    share = float(stated[1]) if stated and stated[1].count(".") < 2 and stated[1] != "." else 0.0
    if not 1 <= share <= 90:
        raise InputError(f"--test is {text!r:.40}; expected a percentage of 1 to 90, such as last:30%")
    present = np.unique(data.trajectory)
    numbers, labels, held = np.empty_like(data.trajectory), [], []
    for index in present:
        samples = np.flatnonzero(data.trajectory == index)
        first, last = np.split(samples, [len(samples) - round(share / 100 * len(samples))])
        parts = np.array_split(first, BLOCKS) if len(present) == 1 else [first]
        if not len(last) or min(map(len, parts)) < 1:
            raise InputError(f"trajectory '{data.label[index]}' has {len(samples)} samples, too few for --test {text}")
        for place, part in enumerate(parts):
            numbers[part] = len(labels)
            labels.append(f"{data.label[index]}[{place if len(parts) > 1 else 'first'}]")
        numbers[last] = len(labels)
        held.append(f"{data.label[index]}[last]")
        labels.append(held[-1])
    return data._replace(trajectory=numbers, label=np.array(labels)), held
