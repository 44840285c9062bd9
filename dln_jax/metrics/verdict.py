"""Verdict on a fitted model, good, doubtful or refused, by its torques on held-out motions or by predicted motions.

The mean squared error e of a joint is compared with four numbers from the same samples: the variance v of its torque
(the error of predicting the mean), its mean square z (the error of predicting zero), the variance n of its noise, and
the error of the robot's own file. A joint is:

    explained     e <= UNEXPLAINED v + NOISE n
    unexplained   e >= v: a constant would have done as well
    doubtful      in between; if the mean of e / v over all joints exceeds FAILED, the fit is refused. Also if e exceeds
                  both FAR_FROM_NOISE n and COUNTS v: the model lacks something, or its parameters are not determined
    unseen        its torque does not rise above its noise (n >= v / 2) and e <= NOISE n: no conclusion

A constant torque, for example of a passive joint, is judged in units of the mean square of all torques.

A fit is doubtful instead of refused if averaging over a quarter of the torque's period leaves less than HALF of the
unexplained share. Such errors come from noisy accelerations or torques, not from a wrong sign, order or unit.

A predicted motion escapes if a state is not finite, or if a momentum or position exceeds `RANGE` times the largest
measured magnitude. Angles may grow, since a pendulum can turn over. The error of a motion is the mean square over one
period of the system, over measured columns, after the samples to which the start was fitted. Chaotic motions later
diverge from any model. The unit of the error is the smallest error of four guesses without a model: rest, no force, the
mean of the test motions, or the variance of the data:

    refused    a motion escapes, or the median error exceeds FAILED (an rms error of half the unit)
    doubtful   it exceeds UNEXPLAINED; MOTION_NOISE times the variance of the noise is added to both limits, but a
               refused model is at least as bad as a guess, and a good one has at most HALF of its error
    rates      measured rates at the test states must be explained by the same two limits
"""

import itertools
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d

from dln_jax.metrics.phase_space import Motions, free_motions
from dln_jax.types import InputError

Level = Literal["good", "doubtful", "refused"]
LEVELS: tuple[Level, ...] = ("good", "doubtful", "refused")
"""Levels in the order of their numbers in metrics.json: 0, 1 and 2."""
UNEXPLAINED, FAILED = 0.05, 0.25
"""Largest unexplained fraction of a joint's torque variance in a good fit (an rms error of 22 %), and mean fraction of
all joints at which a fit is refused (50 %)."""
NOISE = 2.0
"""Errors up to this multiple of the noise variance count as noise, because the variance is an estimate."""
FAR_FROM_NOISE, COUNTS = 4.0, 0.005
"""A fit is doubtful if a joint's error exceeds this multiple of its noise variance and this fraction of the torque's
variance (an rms error of 7 %)."""
WORSE, MUCH_WORSE = 0.01, 2.0
"""A fit is worse than the robot's file if its mean nMSE is larger by the first number, and is refused if it is also
larger by the second as a factor."""
CONSTANT = 1e-12
"""A torque is constant if its variance is below this fraction of the mean square of all torques."""

RANGE, MOTION_NOISE, HALF = 10.0, 4.0, 0.5
"""Distance relative to the data beyond which a motion has escaped; factor on the noise variance, which counts twice
because the measured initial state is noisy too, and may grow; largest error of a good model relative to a guess, at any
noise."""


class Verdict(NamedTuple):
    """Verdict on a fit, in words."""

    level: Level
    reason: str
    """Numbers behind the verdict."""
    remedy: str = ""
    """Recommended action; empty if the fit is good."""

    @property
    def number(self) -> int:
        """The entry `verdict` of metrics.json: 0 good, 1 doubtful, 2 refused."""
        return LEVELS.index(self.level)

    @property
    def line(self) -> str:
        """The verdict in one line for the user."""
        return f"verdict: {self.level}: {self.reason}" + (f"; {self.remedy}" if self.remedy else "")


class HeldOut(NamedTuple):
    """Mean squares of the joints [d] over held-out samples, (N m)² or N²."""

    error: Float[np.ndarray, " d"]
    """Error of the model's torques."""
    mean: Float[np.ndarray, " d"]
    """Error of predicting the mean, which is the torque's variance; of the whole recording if blocks are held out."""
    zero: Float[np.ndarray, " d"]
    """Error of predicting zero."""
    noise: Float[np.ndarray, " d"] | None = None
    """Noise variance of the measured torque, if it was estimated."""
    file: Float[np.ndarray, " d"] | None = None
    """Error of the torques that the robot's file predicts, if there is one."""
    slow: Float[np.ndarray, " d"] | None = None
    """Error of averages over a quarter of the torques' period, relative to their variance; `None` if unknown."""

    @property
    def unit(self) -> Float[np.ndarray, " d"]:
        """Scale of the errors: the torque's variance or, if it does not vary, the mean square of all torques."""
        return np.where(self.mean > CONSTANT * self.zero.mean(), self.mean, self.zero.mean())


def held_out(
    predicted: Float[np.ndarray, "N d"],
    measured: Float[np.ndarray, "N d"],
    *,
    noise: Float[np.ndarray, " d"] | None = None,
    file: Float[np.ndarray, "N d"] | None = None,
    recording: Float[np.ndarray, "M d"] | None = None,
) -> HeldOut:
    """Computes the numbers for a verdict.

    Args:
        predicted: torques of the model.
        measured: torques of motions that the model has not seen.
        noise: standard deviation of each torque's noise, for example from `data.encoders.sampling.noise_of`; NaN if
            unknown.
        file: torques that the robot's file predicts.
        recording: torques of the whole recording, if the held-out samples are blocks of it; the variance of single
            blocks may be small by chance.

    Raises:
        InputError: there are no samples.
    """
    if not len(measured):
        raise InputError("there are no held-out samples to judge a fit by; hold out some motions")
    quarter = quarter_period(measured[None], np.ones(measured.shape[1], bool))
    error, torque = (uniform_filter1d(x, quarter, axis=0) for x in (predicted - measured, measured))
    variance = None if noise is None else np.where(np.isfinite(noise), noise, 0.0) ** 2
    return HeldOut(
        error=np.mean((predicted - measured) ** 2, axis=0),
        mean=np.var(measured if recording is None else recording, axis=0),
        zero=np.mean(measured**2, axis=0),
        noise=variance,
        file=None if file is None else np.mean((file - measured) ** 2, axis=0),
        slow=np.mean(error**2, axis=0) / np.maximum(np.var(torque, axis=0), CONSTANT * np.mean(measured**2) or 1.0),
    )


def judge(errors: HeldOut, names: Sequence[str] | None = None, *, quantity: str = "torque") -> Verdict:
    """Returns the verdict on held-out torques, or on another quantity of the same joints.

    Args:
        errors: mean squares of the joints.
        names: names of the joints; by default joint 1, joint 2, ...
        quantity: name of the quantity in the reason.
    """
    names = [f"joint {k + 1}" for k in range(len(errors.error))] if names is None else names
    if not errors.zero.any():
        return Verdict("refused", f"every held-out {quantity} is zero", "record driven motions with measured torques")
    share = errors.error / errors.unit
    if not np.isfinite(share).all():
        which = _listed(names, ~np.isfinite(share))
        return Verdict("refused", f"the {quantity} of {which} is not finite on held-out motions", "check the data")
    noise = np.zeros_like(share) if errors.noise is None else errors.noise / errors.unit
    unseen = (noise >= 0.5) & (share > UNEXPLAINED) & (share <= NOISE * noise)
    numbers = _numbers(errors, share, noise, names)
    unexplained = (share >= 1) & ~unseen
    if share.mean() >= 1 or unexplained.any() or np.where(unseen, 0.0, share - NOISE * noise).mean() >= FAILED:
        slow = share if errors.slow is None else errors.slow
        if (slow < 1).all() and slow.mean() < min(FAILED, HALF * share.mean()):
            reason = f"errors are too fast for the motion, nMSE {slow.mean():.3g} over quarter periods: {numbers}"
            return Verdict(
                "doubtful", reason, "accelerations or torques are noisy: try --cutoff with a lower frequency"
            )
        beyond = f"more than {FAILED:.0%} of the {quantity} is unexplained on average over the joints"
        constant = f"the {quantity} of {_listed(names, unexplained)} is predicted no better than by a constant"
        remedy = "check the sign, order and unit of tau, and the times of the log (check_data), or record more motions"
        return Verdict("refused", f"{constant if unexplained.any() else beyond}: {numbers}", remedy)
    of_file = np.inf if errors.file is None else np.mean(errors.file / errors.unit)
    if share.mean() > of_file + WORSE:
        level = "refused" if share.mean() > MUCH_WORSE * of_file else "doubtful"
        remedy = "keep the file's values, or record more and different motions"
        return Verdict(level, f"the robot's file predicts held-out torques better: {numbers}", remedy)
    doubtful = (share > UNEXPLAINED + NOISE * noise) & ~unseen
    far = (noise > 0) & (share > np.maximum(FAR_FROM_NOISE * noise, COUNTS)) & ~unseen
    if doubtful.any() or far.any():
        reason = f"more than {UNEXPLAINED:.0%} of the {quantity} of {_listed(names, doubtful)} is unexplained"
        if not doubtful.any():
            ratio = np.max(share[far] / noise[far])
            reason = f"errors of {_listed(names, far)} are up to {ratio:.3g} times the noise of the {quantity}"
        reason += f": {numbers}"
        remedy = "add what the model lacks (friction, a load), remove outliers, or record more motions; see check_data"
        return Verdict("doubtful", reason, remedy)
    if unseen.all():
        reason = f"no {quantity} rises above its noise: {numbers}"
        return Verdict("doubtful", reason, "record faster motions, or sample them more often")
    if unseen.any():
        numbers += f"; the {quantity} of {_listed(names, unseen)} does not rise above its noise"
    return Verdict("good", numbers)


def judge_motions(
    predicted: Sequence[Motions],
    truth: Sequence[Motions],
    *,
    size: Float[np.ndarray, " two_d"],
    bounded: Bool[np.ndarray, " two_d"],
    noise: Float[np.ndarray, " two_d"] | None = None,
    measured: Bool[np.ndarray, " two_d"] | None = None,
    fitted: int = 1,
    rates: Float[np.ndarray, " r"] | tuple[float, ...] = (0.0,),
) -> Verdict:
    """Returns the verdict on predicted test motions.

    Args:
        predicted: motions of the model.
        truth: measured or exact motions at the same times.
        size: standard deviation of q and p in the data.
        bounded: mask of q and p that must stay bounded: everything except angles.
        noise: standard deviation of the measurements of q and p, if known.
        measured: mask of the measured q and p; only these count (default: all).
        fitted: number of first samples to which the start was fitted; they do not count.
        rates: fractions of the variance of measured rates that the model leaves unexplained at test states.
    """
    remedy = "state the plant's --needs, try another --model, or record more motions"
    counts = np.ones(len(size), bool) if measured is None else measured
    joints = int(counts[: len(size) // 2].sum())
    size, bounded = size[counts], bounded[counts]
    true, states = (
        [np.concatenate([m.q, m.p], axis=2)[..., counts] for m in motions] for motions in (truth, predicted)
    )
    mean = np.mean(np.concatenate([exact.reshape(-1, len(size)) for exact in true]), axis=0)
    errors, escaped = [], []
    for exact, model in zip(true, states, strict=True):
        farthest = RANGE * np.maximum(np.abs(exact).max(axis=(0, 1)), size)
        # A state that is not finite compares as false.
        escaped += (~np.where(bounded, np.abs(model) <= farthest, np.isfinite(model)).all(axis=(1, 2))).tolist()
        quarter = quarter_period(exact, bounded)
        guesses = model, mean, *free_motions(exact, joints, fitted=fitted, quarter=quarter)
        with np.errstate(over="ignore", invalid="ignore"):
            off = [((guess - exact) / size)[:, fitted : fitted + 4 * quarter] for guess in guesses]
            errors.append([np.mean(error**2, axis=(1, 2)) for error in off])
    if any(escaped):
        many = f"{sum(escaped)} of {len(escaped)} predicted test motions"
        return Verdict("refused", f"{many} grow beyond {RANGE:g} times the range of the data", remedy)
    every = np.concatenate(errors, axis=1)
    median, *guessed = np.median(every, axis=1)
    unit, share = min(1.0, *guessed), 0.0
    if noise is not None:
        share = float(np.mean(np.minimum(noise[counts] / size, 1.0) ** 2))
    numbers = f"MSE of predicted test motions over the variance: median {median:.2g}, worst {every[0].max():.2g}"
    numbers += f" ({len(escaped)} motions, one period), best guess {unit:.2g}"
    numbers += (f", noise {share:.2g}" if share else "") + f", unexplained rates {np.max(rates):.2g}"
    allowed = MOTION_NOISE * share
    if not (median <= FAILED * unit + allowed and median < unit and np.mean(rates) < FAILED + allowed):
        return Verdict("refused", numbers, remedy)
    if median > min(UNEXPLAINED * unit + allowed, HALF * unit) or np.max(rates) > UNEXPLAINED + allowed:
        return Verdict("doubtful", numbers, remedy)
    return Verdict("good", numbers)


def worst(first: Verdict, *others: Verdict, causes: Sequence[str] = ()) -> Verdict:
    """Returns the most severe verdict, and joins the reasons and remedies of equally severe ones.

    Args:
        causes: faults of the log, added to the reasons unless the verdict is good.
    """
    every = [first, *others]
    level = LEVELS[max(verdict.number for verdict in every)]
    if level == "good":
        return first
    severe = [verdict for verdict in every if verdict.level == level]
    reasons = [*(verdict.reason for verdict in severe), *(f"in the log, {cause}" for cause in causes)]
    remedies = dict.fromkeys(verdict.remedy for verdict in severe if verdict.remedy)
    return Verdict(level, "; ".join(reasons), "; ".join(remedies))


def verdict_metrics(errors: HeldOut, verdict: Verdict) -> dict[str, float | int]:
    """Returns entries of metrics.json: the verdict as a number, and the mean nMSE of each comparison."""
    compared = {"zero": errors.zero, "noise": errors.noise, "file": errors.file}
    means = {f"{name}_nmse": float(np.mean(e / errors.unit)) for name, e in compared.items() if e is not None}
    return {"verdict": verdict.number, **means}


def _numbers(errors: HeldOut, share: np.ndarray, noise: np.ndarray, names: Sequence[str]) -> str:
    worst = int(np.argmax(share))
    compared = [f"predicting zero {np.mean(errors.zero / errors.unit):.3g}"]
    compared += [] if errors.file is None else [f"the robot's file {np.mean(errors.file / errors.unit):.3g}"]
    compared += [f"noise {noise.mean():.2g}"] if noise.any() else []
    single = "" if len(share) == 1 else f", worst {names[worst]} {share[worst]:.3g}"
    return f"held-out nMSE {share.mean():.3g}{single} ({', '.join(compared)})"


def _listed(names: Sequence[str], chosen: np.ndarray) -> str:
    return ", ".join(itertools.compress(names, chosen))


def quarter_period(states: Float[np.ndarray, "K T n"], bounded: Bool[np.ndarray, " n"]) -> int:
    """Returns a quarter period in samples: the first lag at which the autocorrelation of the motions is not positive.

    All columns have equal weight. Angles, which may turn over, enter as cosine and sine. White noise has no influence.
    """
    parts = np.stack([np.where(bounded, states, np.cos(states)), np.where(bounded, 0.0, np.sin(states))])
    about = parts - parts.mean(axis=2, keepdims=True)
    size = np.sqrt(np.sum(about**2, axis=(0, 1, 2)))
    spectrum = np.abs(np.fft.rfft(about / np.where(size > 0, size, 1.0), 2 * states.shape[1], axis=2)) ** 2
    return max(int(np.argmax(np.fft.irfft(spectrum.sum(axis=(0, 1, 3)))[: states.shape[1]] <= 0)), 1)
