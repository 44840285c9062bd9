"""Verdict on a model of motions: good, doubtful or refused, by its predictions of test motions.

A predicted motion escapes if a state is not finite, or a momentum or a position is further from zero than `RANGE` times
the farthest measured one; angles may grow, as a pendulum turns over. The error of a motion is the mean square of its
first `EARLY` samples over the variance of the data, because chaotic motions diverge from any model later on.

    refused    a motion escapes, or the median error exceeds FAILED (an rms error of half the spread)
    doubtful   it exceeds UNEXPLAINED; NOISE times the share of noise in the variance is added to both
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from dln_jax.metrics.phase_space import Motions
from dln_jax.metrics.verdict import FAILED, UNEXPLAINED, Verdict

EARLY = 30
"""Number of samples of the error."""
RANGE = 10.0
NOISE = 4.0
"""Noise in the measured initial state moves a motion as far as the noise that it is compared with, and may grow."""
REMEDY = "state the plant's --needs, try another --model, or record more motions"


def judge_motions(
    predicted: Sequence[Motions],
    truth: Sequence[Motions],
    *,
    size: Float[np.ndarray, " two_d"],
    bounded: Bool[np.ndarray, " two_d"],
    noise: Float[np.ndarray, " two_d"] | None = None,
) -> Verdict:
    """Returns the verdict on predicted test motions.

    Args:
        predicted: motions of the model.
        truth: measured or exact motions at the same times.
        size: standard deviation of q and p in the data.
        bounded: mask of q and p that cannot grow without limit: all but angles.
        noise: standard deviation of the measurements of q and p, if known.
    """
    errors, escaped, total = [], 0, 0
    for theirs, ours in zip(truth, predicted, strict=True):
        true, found = (np.concatenate([each.q, each.p], axis=2) for each in (theirs, ours))
        farthest = RANGE * np.maximum(np.abs(true).max(axis=(0, 1)), size)
        # A state that is not finite compares as false.
        inside = np.where(bounded, np.abs(found) <= farthest, np.isfinite(found)).all(axis=(1, 2))
        with np.errstate(over="ignore", invalid="ignore"):
            squares = ((found - true)[:, :EARLY] / size) ** 2
        errors += np.where(inside, squares.mean(axis=(1, 2)), np.inf).tolist()
        escaped += int((~inside).sum())
        total += len(inside)
    median, share = float(np.median(errors)), 0.0
    if noise is not None:
        share = float(np.mean(np.minimum(noise / size, 1.0) ** 2))
    if escaped:
        reason = f"{escaped} of {total} predicted test motions grow beyond {RANGE:g} times the range of the data"
        return Verdict("refused", reason, REMEDY)
    numbers = f"squared error of predicted test motions over the variance {median:.2g}, worst {max(errors):.2g}"
    numbers += f" (median of {total}; first {EARLY} samples)" + (f", noise {share:.2g}" if share else "")
    if not median <= FAILED + NOISE * share:
        return Verdict("refused", numbers, REMEDY)
    if median > UNEXPLAINED + NOISE * share:
        return Verdict("doubtful", numbers, REMEDY)
    return Verdict("good", numbers)
