"""Parts of a dataset: splits, segments without a gap, windows, and columns in the order of a robot's joints.

Splits are by trajectory, never by sample, since neighbouring samples of a trajectory are almost copies.
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from dln_jax.data.joints import PER_JOINT, match_names
from dln_jax.data.schema import Trajectories
from dln_jax.types import InputError, SampleIndex, SampleVector, require_positive, require_seed

PER_SAMPLE = ("t", "trajectory", *PER_JOINT)
LEAST_TRAJECTORIES = 3
"""Fewest trajectories for a split: one for each of training, validation and test."""
BLOCKS = 10
"""Number of time blocks per trajectory if there are too few trajectories."""
GAP = 1.5
"""A step longer than this multiple of its trajectory's median step is a gap."""
EVERY_SIXTH = slice(5, None, 6)
LAST = re.compile(r"last:\s*(\d+\.?\d*|\.\d+)\s*%")
ALL_IN_BLOCKS = "blocks"


class Split(NamedTuple):
    """Three disjoint sets of trajectories: for training, for model selection and for the final test."""

    train: Trajectories
    validation: Trajectories
    test: Trajectories


def select_samples(data: Trajectories, samples: np.ndarray | slice) -> Trajectories:
    """Selects samples by a mask, indices or a slice; labels stay unchanged."""
    return data._replace(**{key: array[samples] for key in PER_SAMPLE if (array := getattr(data, key)) is not None})


def select(data: Trajectories, indices: Sequence[int] | np.ndarray) -> Trajectories:
    """Selects trajectories by their indices; indices and labels stay unchanged."""
    return select_samples(data, np.isin(data.trajectory, indices))


def every(data: Trajectories, step: int) -> Trajectories:
    """Keeps every `step`-th sample."""
    return select_samples(data, slice(None, None, step))


def with_joints(data: Trajectories, names: Sequence[str]) -> Trajectories:
    """Selects, orders and renames the columns of the data for these joints; data without names stay unchanged.

    Remarks list the matched names (see `data.joints`), and the motion of joints that are left out.

    Raises:
        InputError: the names do not match, or data without names have another number of joints.
    """
    d = data.degrees_of_freedom
    if d < len(names) or (data.joint_names is None and d != len(names)):
        raise InputError(f"the data have {d} joints, the robot {len(names)}: {', '.join(names):.200}")
    if data.joint_names is None:
        return data
    own = data.joint_names.tolist()
    match = match_names(own, names)
    order = [own.index(match[name]) for name in names]
    remarks = list(data.remarks)
    if any(name != other for name, other in match.items()):
        remarks.append("joints matched by name: " + ", ".join(f"{other}={name}" for name, other in match.items()))
    if left_out := [(own[k], np.ptp(data.q[:, k])) for k in range(d) if k not in order]:
        moves = ", ".join(f"{name} (moved by {reach:.3g})" for name, reach in left_out)
        remarks.append(f"not joints of the robot, left out: {moves}")
    columns = {key: array[:, order] for key in PER_JOINT if (array := getattr(data, key)) is not None}
    needs = None if data.needs is None else data.needs._replace(joints=tuple(data.needs.joints[k] for k in order))
    return data._replace(**columns, joint_names=np.array(names), needs=needs, remarks=tuple(remarks))


def segments(t: SampleVector, trajectory: SampleIndex, *, gap: float = GAP) -> list[Int[np.ndarray, " n"]]:
    """Returns the sample indices of all segments; a step longer than `gap` times the median step ends a segment.

    Raises:
        InputError: `gap` is not above 1, or no trajectory has two samples.
    """
    if not gap > 1:
        raise InputError(f"gap is {gap}; expected a multiple of the median time step above 1")
    if not (np.diff(trajectory) == 0).any():
        raise InputError("no trajectory has two samples, so the data contain no motion; record longer trajectories")
    pieces = []
    for samples in np.split(np.arange(len(t)), np.flatnonzero(np.diff(trajectory)) + 1):
        steps = np.diff(t[samples])
        longest = gap * np.median(steps) if len(steps) else np.inf
        pieces.extend(np.split(samples, np.flatnonzero(steps > longest) + 1))
    return pieces


def window_indices(data: Trajectories, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the sample indices [W, T] of consecutive windows, which share their end samples, and sample weights.

    Windows lie within segments. The rest of a segment is a shorter window, padded with its last sample at weight 0.

    Raises:
        InputError: a length below 2, or gaps between all samples.
    """
    if length < 2:
        raise InputError(f"length is {length}; expected a window of at least 2 samples")
    pieces = [
        segment[first : first + length]
        for segment in segments(data.t, data.trajectory)
        for first in range(0, len(segment) - 1, length - 1)
    ]
    if not pieces:
        raise InputError("no two samples follow one another without a gap; record longer motions")
    indices = np.stack([np.pad(piece, (0, length - len(piece)), mode="edge") for piece in pieces])
    return indices, np.stack([np.arange(length) < len(piece) for piece in pieces]).astype(float)


def drawn(data: Trajectories, most: int, seed: int) -> Trajectories:
    """Draws at most `most` samples and keeps their order; `InputError` for a number or seed out of range."""
    require_positive(samples=most)
    require_seed(seed)
    count = len(data.t)
    if count <= most:
        return data
    rows = np.sort(np.random.default_rng([seed, count]).choice(count, most, replace=False))
    return select_samples(data, rows)


def in_blocks(data: Trajectories, blocks: int, *, last: float = 0.0) -> Trajectories:
    """Cuts every trajectory into blocks of time, as trajectories "LABEL[0]" and so on.

    The last fraction `last` of a trajectory becomes "LABEL[last]", and a single block before it "LABEL[first]".
    Estimated rates stay unchanged. Neighbouring blocks are nearly identical at their common end.

    Raises:
        InputError: a trajectory has too few samples.
    """
    require_positive(blocks=blocks)
    numbers, labels = np.empty_like(data.trajectory), []
    names = [*range(blocks), "last"] if blocks > 1 or not last else ["first", "last"]
    for index in np.unique(data.trajectory):
        samples, label = np.flatnonzero(data.trajectory == index), data.label[index]
        first, late = np.split(samples, [len(samples) - round(last * len(samples))])
        parts = [*np.array_split(first, blocks), late][: blocks + (last > 0)]
        if not all(map(len, parts)):
            end = f" and its last {last:.0%}" if last else ""
            raise InputError(
                f"trajectory '{label}' has {len(samples)} samples, too few for {blocks} block(s){end}; record more"
            )
        for name, part in zip(names, parts, strict=False):
            numbers[part] = len(labels)
            labels.append(f"{label}[{name}]")
    return data._replace(trajectory=numbers, label=np.array(labels))


def label_indices(data: Trajectories, labels: Sequence[str]) -> np.ndarray:
    """Returns the indices of the trajectories with these labels.

    Raises:
        InputError: an unknown label.
    """
    known = list(data.label)
    unknown = [label for label in labels if label not in known]
    if unknown:
        shown = ", ".join(known[:30]) + (", ..." if len(known) > 30 else "")
        raise InputError(f"no trajectory is labelled '{unknown[0]}'; choose the test labels from: {shown}")
    return np.array([known.index(label) for label in labels], dtype=int)


def split(
    data: Trajectories,
    *,
    test: Sequence[str] | None = None,
    validation_share: float = 0.1,
    seed: int = 0,
    motion: Int[np.ndarray, " T"] | None = None,
    chosen: slice = EVERY_SIXTH,
) -> Split:
    """Splits trajectories into test, validation and training sets.

    The validation trajectories, at least one, are drawn from those outside the test set, so model selection never sees
    the test.

    Args:
        data: trajectories.
        test: labels of the test trajectories (default: the trajectories of the chosen motions).
        validation_share: fraction of the other trajectories for validation; zero for none.
        seed: seed of the draw.
        motion: motion number of each trajectory, from `repeated_motions.motion_numbers`. Trajectories of one motion
            stay together if there are enough motions (default: each trajectory is its own motion).
        chosen: test motions if there are no labels.

    Raises:
        InputError: a label is unknown or has no samples, too few trajectories remain for training and validation, a
            test trajectory is a copy of another one, or the seed is out of range.
    """
    require_seed(seed)
    present = np.unique(data.trajectory)
    uses, least = (" and validation", LEAST_TRAJECTORIES) if validation_share else ("", 2)
    held = by_motion(present, motion, chosen, least=least) if test is None else label_indices(data, test)
    empty = np.setdiff1d(held, present)
    if len(empty):
        raise InputError(f"trajectory '{data.label[empty[0]]}' has no samples to test by; choose other test labels")
    rest = np.setdiff1d(present, held)
    if len(rest) < least - 1 or not len(held):
        raise InputError(
            f"{len(present)} trajectories, {len(held)} of them for the test, leave {len(rest)} for training{uses}; "
            f"at least {least} in all are needed: record more, test on fewer, or cut long ones and index the parts"
        )
    train, validation = select(data, rest), select(data, [])
    require_no_copies(train, select(data, held))
    if validation_share:
        train, validation = hold_out(train, validation_share, seed, motion)
    return Split(train, validation, test=select(data, held))


def by_motion(
    present: Int[np.ndarray, " t"],
    motion: Int[np.ndarray, " T"] | None,
    chosen: slice | Int[np.ndarray, " c"],
    *,
    least: int,
) -> Int[np.ndarray, " h"]:
    """Returns the trajectories of the chosen motions, or of the last motion if the choice is empty.

    If motions repeat and the choice covers more than half of the trajectories, the motion with the fewest trajectories
    replaces it. With fewer than `least` motions, every trajectory counts as a motion.
    """
    of = _shown(present, motion, least)
    every, counts = np.unique(of, return_counts=True)
    some = every[chosen] if len(every[chosen]) else every[-1:]
    if len(every) < len(present) and 2 * np.isin(of, some).sum() > len(present):
        some = every[counts == counts.min()][-1:]
    return present[np.isin(of, some)]


def _shown(present: np.ndarray, motion: np.ndarray | None, least: int) -> np.ndarray:
    """Returns the motion of each trajectory; with fewer than `least` motions, the trajectories themselves."""
    return present if motion is None or len(np.unique(motion[present])) < least else motion[present]


def hold_out(
    data: Trajectories, share: float, seed: int, motion: Int[np.ndarray, " T"] | None = None
) -> tuple[Trajectories, Trajectories]:
    """Draws training and validation trajectories, at least one of each; `motion` as for `split`.

    Raises:
        InputError: fewer than two trajectories, a share outside (0, 1), or a seed out of range.
    """
    require_seed(seed)
    present = np.unique(data.trajectory)
    motions = len(np.unique(_shown(present, motion, 2)))
    count = held_out(motions, share, "trajectories")
    chosen = np.random.default_rng(seed).choice(motions, size=count, replace=False)
    held = by_motion(present, motion, np.sort(chosen), least=2)
    return select(data, np.setdiff1d(present, held)), select(data, held)


def held_out(count: int, share: float, what: str) -> int:
    """Returns the number of items for validation; at least one is held out, and one remains for training.

    Raises:
        InputError: fewer than two items, or a share outside (0, 1).
    """
    if count < 2:
        raise InputError(f"there are {count} {what} for training and validation; expected at least 2: add {what}")
    if not 0 < share < 1:
        raise InputError(f"validation_share is {share}; expected a number between 0 and 1")
    return min(max(1, round(share * count)), count - 1)


def require_no_copies(seen: Trajectories, test: Trajectories) -> None:
    """Raises `InputError` if a test trajectory is a copy of a training one; skips motionless trajectories."""

    def contents(data: Trajectories) -> dict[int, int]:
        states = np.hstack([data.q, data.qd, data.qdd, data.tau])
        first = np.flatnonzero(np.diff(data.trajectory, prepend=-1))
        motions = zip(data.trajectory[first].tolist(), np.split(states, first[1:]), strict=True)
        return {hash(part.tobytes()): index for index, part in motions if np.ptp(part, axis=0).any()}

    known = contents(seen)
    for content, index in contents(test).items():
        if content in known:
            raise InputError(
                f"test trajectory '{test.label[index]}' is a copy of training trajectory "
                f"'{seen.label[known[content]]}'; remove one of them"
            )


def merged(sets: Split) -> Trajectories:
    """Merges the trajectories of a split in their original order."""
    parts = [part for part in sets if len(part.t)]
    order = np.argsort(np.concatenate([part.trajectory for part in parts]), kind="stable")
    joined = {
        key: np.concatenate([getattr(part, key) for part in parts])[order]
        for key in PER_SAMPLE
        if getattr(parts[0], key) is not None
    }
    return sets.train._replace(**joined)


def is_cut(text: str | None) -> bool:
    """Whether a text cuts trajectories (`last:30%`, `blocks`) instead of naming some."""
    return text is not None and (text.startswith("last:") or text == ALL_IN_BLOCKS)


def stated_test(data: Trajectories, text: str | None) -> tuple[Trajectories, list[str] | None]:
    """Cuts the data as the text states, and returns the test labels; `None` leaves the choice to the split.

    `last:30%` holds out the last 30 % of the samples of every trajectory, as "LABEL[last]". `blocks` cuts every
    trajectory into ten blocks of time. Other text is a list of labels. A single trajectory is cut into blocks before
    its last part, which leaves data for validation.

    Raises:
        InputError: a percentage outside 1 to 90, or a trajectory that is too short for it.
    """
    if text is None or not is_cut(text):
        return data, None if text is None else [label.strip() for label in text.split(",")]
    if text == ALL_IN_BLOCKS:
        return in_blocks(data, BLOCKS), None
    stated = LAST.fullmatch(text)
    if stated is None or not 1 <= float(stated[1]) <= 90:
        raise InputError(f"--test is {text!r:.40}; expected a percentage of 1 to 90, such as last:30%")
    labels = data.label[np.unique(data.trajectory)]
    cut = in_blocks(data, BLOCKS if len(labels) == 1 else 1, last=float(stated[1]) / 100)
    return cut, [f"{label}[last]" for label in labels]
