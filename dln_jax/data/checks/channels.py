"""Findings about data, and checks of sampling times, of single channels, and of qd and qdd against derivatives of q."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from dln_jax.data.encoders.sampling import step_of, timing
from dln_jax.data.encoders.smoothing import PART, Smoothed
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import LEAST_TRAJECTORIES
from dln_jax.types import JointSamples, JointVector, SampleIndex

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""An error would make a learned model wrong, so commands stop. A warning makes it less accurate. A note informs."""
JITTER = 0.05
"""Largest standard deviation of the steps, relative to the step."""
SLOWEST = 1.0
"""Hz: at a lower rate, t is probably not in seconds."""
UNEQUAL = 0.2
"""Largest relative difference between the rates of trajectories."""
TURNS = 4 * np.pi
"""rad: two turns; larger angles of an arm are suspicious."""
WEAK = 0.03
"""A joint with less than this fraction of the median joint's velocity is hardly excited."""
COARSE = 3e-4
"""rad: smallest encoder step reported, 1/20000 of a turn."""
RUN = 4
"""Samples at exactly the same extreme value that count as a flat top."""
SHARE = 2e-3
"""A channel with a larger fraction of its samples in flat tops counts as saturated."""
SPIKE = 4.0
"""A spike exceeds the usual change of the channel over two samples by this factor."""
CLEAR = 3.0
"""A spike exceeds the range of its four neighbours by this factor."""
ABRUPT = 0.5
"""A channel enters or leaves a clipping limit by more than this fraction of the typical step."""
FAST, HIDDEN = 0.3, 0.5
"""A joint moves if it is faster than the first multiple of its root mean square speed. Zero torques are reported if
their fraction of these samples exceeds the second number."""
FILTER = "interpolate to equal steps with smooth() or --cutoff auto"
RADIAN = 180 / np.pi
ALIKE = 0.9
"""Two signals with a higher correlation, after scaling and delay, count as equal."""
UNLIKE = 0.5
"""Two signals with a lower correlation count as unrelated."""
EXCHANGED = 0.3
"""qd and qdd count as exchanged if exchanging them reduces the error below this fraction."""
LATE = 0.5
"""Smallest delay reported, in samples."""
FARTHEST = 0.25
"""s: largest delay tested."""
TINY = np.finfo(float).tiny
RATE_REMEDY = "let --cutoff auto derive qd and qdd from q"


class Finding(NamedTuple):
    """A finding, shown to the user as one line."""

    severity: Severity
    check: str
    """Stable lower-case name of the check."""
    observation: str
    """The observation, with numbers."""
    remedy: str
    joints: tuple[int, ...] = ()
    """Affected joints, counted from 0; empty for the whole log."""

    @property
    def line(self) -> str:
        """The finding as one line of text."""
        return f"{self.severity}: {self.observation}; {self.remedy}"


Case = tuple[Severity, str, bool | np.bool_ | Bool[np.ndarray, " d"], str, str]
"""Severity, check, whether it holds (for the whole log, or a mask of joints), observation and remedy."""


def findings_of(*cases: Case) -> list[Finding]:
    """Returns the findings for the cases that hold.

    In an observation on joints, {} becomes "joint 3" or "joints 1, 2 and 4", counted from 1 as in figures.
    """
    findings = []
    for severity, check, concerned, observation, remedy in cases:
        joints = tuple(map(int, np.flatnonzero(concerned))) if np.ndim(concerned) else ()
        if joints:
            *others, last = (str(joint + 1) for joint in joints)
            names = f"joints {', '.join(others)} and {last}" if others else f"joint {last}"
            observation = observation.replace("{}", names, 1)
        if np.any(concerned):
            findings.append(Finding(severity, check, observation, remedy, joints))
    return findings


def check_times(data: Trajectories) -> list[Finding]:
    """Checks rate, jitter, gaps and the number of trajectories for a split."""
    counts = np.unique(data.trajectory, return_counts=True)[1]
    few = f"the number of trajectories is {len(counts)}; a split by trajectory needs {LEAST_TRAJECTORIES}"
    cases: list[Case] = [
        ("warning", "split", len(counts) < LEAST_TRAJECTORIES, few,
         "record more, or cut the log in time and number the parts"),
    ]  # fmt: skip
    if counts.max() > 1:
        rate, jitter, gaps, longest, rates = timing(data.t, data.trajectory)
        step = f"{1 / rate:.3g} s"
        cases += [
            ("error", "time-unit", rate < SLOWEST, f"samples are {step} apart",
             "give t in seconds if it is in milliseconds or ticks"),
            ("note", "gaps", gaps > 0,
             f"t has {gaps} gap(s): the longest step is {longest:.3g} s, the typical one {step}",
             "cut the log at gaps, as smooth() does; rates across them are guesses"),
            ("warning", "jitter", jitter > JITTER, f"time steps vary by {jitter:.0%}", FILTER),
            ("note", "rates", np.ptp(rates) > UNEQUAL * rate,
             f"trajectories are sampled at {rates.min():.4g} to {rates.max():.4g} Hz", FILTER),
        ]  # fmt: skip
    return findings_of(*cases)


def check_channels(data: Trajectories, rates: np.ndarray | None) -> list[Finding]:
    """Checks for still joints, constant torques, spikes, steps and flat tops; `rates` are qd of the filtered q."""
    still = np.ptp(data.q, axis=0) <= 1e-9 * max(1.0, np.abs(data.q).max())
    speed = np.full(len(still), np.inf) if rates is None else rates.std(axis=0)
    findings = findings_of(
        ("warning", "unexcited", still, "the position of {} is constant",
         "move it in some trajectories, or leave it out of q: its inertia and friction cannot be learned"),
        ("warning", "unexcited", (speed < WEAK * np.median(speed)) & ~still,
         f"{{}}: the speed is less than {WEAK:.0%} of the other joints' speed",
         "excite it more: the log hardly shows its dynamics"),
    )  # fmt: skip
    if "tau" not in data.estimated:
        # A joint without a motor has zero torque; a passive system has only such joints.
        driven = np.ones(len(still), bool)
        if data.needs is not None and data.needs.actuation is not None:
            driven = np.any(np.asarray(data.needs.actuation) != 0, axis=1)
        dead = driven & ~data.tau.any(axis=0) & ~still
        fast = np.abs(data.qd) > FAST * np.sqrt(np.mean(data.qd**2, axis=0))
        zero = np.sum((data.tau == 0) & fast, axis=0) / np.maximum(fast.sum(axis=0), 1)
        hidden = driven & (zero > HIDDEN) & ~dead & ~still
        findings += findings_of(
            ("warning", "dead-torque", dead, "the torque of {} is zero in all samples, although the position changes",
             "log that torque; or state in needs, by actuation, that the joint has no motor"),
            ("warning", "hidden-torque", hidden,
             f"the torque of {{}} is exactly zero in up to {zero[hidden].max(initial=0.0):.0%} of the moving samples",
             "unless the motors were off, the drivers hide small torques: leave such joints out (--lock)"),
            ("warning", "constant-torque", (np.ptp(data.tau, axis=0) == 0) & (data.tau[0] != 0),
             "the torque of {} is constant", "check that the right channel was logged"),
        )  # fmt: skip
    for key, word, of_spikes, of_limits in (
        ("q", "position", "leave those samples out",
         "check whether it is at its stop or the log is clipped; leave those samples out"),
        ("tau", "torque", "leave those samples out, or let identify weigh them by --robust",
         "avoid the limits of the motors, or leave those samples out"),
    ):  # fmt: skip
        if key in data.estimated:
            continue
        channels = getattr(data, key)
        spikes, steps = _spikes(channels, data.trajectory).sum(axis=0), step_of(channels)
        pairs = zip(channels.T, steps, strict=True)
        flat = np.array([flat_share(channel, data.trajectory, step) for channel, step in pairs])
        findings += findings_of(
            ("warning", "spikes", spikes > 0, f"the {word} of {{}} has {spikes.sum()} spike(s)", of_spikes),
            ("warning", f"saturation-{key}", flat > SHARE,
             f"the {word} of {{}} is cut off flat in up to {flat.max():.1%} of the samples", of_limits),
        )  # fmt: skip
    steps = step_of(data.q)
    return findings + findings_of(
        ("note", "quantisation", steps > COARSE, f"q of {{}} comes in steps of up to {steps.max():.2g}",
         "filter before rates are derived: --cutoff auto, or smooth()")
    )  # fmt: skip


def _spikes(values: np.ndarray, trajectory: np.ndarray) -> np.ndarray:
    """Returns a mask [N, k] of spikes: samples that differ from their neighbours by much more than the usual change.

    The difference is to the median of the two neighbours on either side. The usual change comes from the upper
    quartiles, over all samples, of this difference and of the neighbours' range.
    """
    mask = np.zeros(values.shape, bool)
    inside = np.flatnonzero(trajectory[4:] == trajectory[:-4]) + 2
    if len(inside) < 50:
        return mask
    neighbours = [values[inside + k] for k in (-1, 1, -2, 2)]
    spread = np.ptp(neighbours, axis=0)
    error = np.abs(values[inside] - np.median(neighbours, axis=0))
    usual = np.quantile(error, 0.75, axis=0) + np.quantile(spread, 0.75, axis=0)
    mask[inside] = (error > SPIKE * usual) & (error > CLEAR * spread) & (error > 0)
    return mask


def flat_share(channel: np.ndarray, trajectory: np.ndarray, step: float) -> float:
    """Returns the fraction of samples in runs at the largest or smallest value with an abrupt start or end.

    A motion slows down towards a smooth extreme, and a joint at rest does not move, but a limit cuts a motion off.
    `step` is the channel's step size.
    """
    size = np.ptp(channel)
    if size == 0:
        return 0.0
    same = np.diff(trajectory) == 0
    moves = np.abs(np.diff(channel))
    moving = moves[same & (moves > 1e-9 * size)]
    typical = np.median(moving) if len(moving) else np.inf
    # A smooth extreme of at least RUN samples in steps is entered and left by fewer than three steps.
    abrupt = max(ABRUPT * typical, 3 * float(step))
    jumps = np.r_[False, same & (moves > abrupt), False]  # into each sample, and out of the last
    cut = 0
    for extreme in (channel.max(), channel.min()):
        at = np.abs(channel - extreme) <= 1e-9 * size
        runs = np.flatnonzero(np.diff(np.r_[0, at.astype(int), 0])).reshape(-1, 2)
        lengths = np.diff(runs)[:, 0]
        cut += lengths[(lengths >= RUN) & jumps[runs].any(axis=1)].sum()
    return float(cut / len(channel))


def _match(measured: JointSamples, derived: JointSamples, part: SampleIndex, farthest: int) -> tuple[JointVector, ...]:
    """Matches two signals in every channel by least squares: measured(t) = factor * derived(t - delay).

    Returns the factors, the delays in samples, the correlations, and the ratio of the squared errors without and with
    the delay.
    """
    shifts, columns = np.arange(-farthest, farthest + 1), np.arange(measured.shape[1])
    inside = away_from_ends(part, farthest)
    if len(inside) < 16:
        one = np.ones(len(columns))
        return one, 0 * one, one, one  # too few to contradict
    x = derived[inside]
    along = np.array([np.sum(measured[inside + shift] * x, axis=0) for shift in shifts])
    sizes = np.array([np.sum(measured[inside + shift] ** 2, axis=0) for shift in shifts])
    size = np.maximum(np.sum(x**2, axis=0), TINY)
    relative = (sizes - along**2 / size) / np.maximum(sizes, TINY)
    best = np.argmin(relative, axis=0)
    lowest, along = relative[best, columns], along[best, columns]
    offset = np.array([vertex(errors, place) for errors, place in zip(relative.T, best, strict=True)])
    correlation = np.sqrt(np.maximum(0.0, 1 - lowest)) * np.sign(along)
    gained = relative[farthest] / np.maximum(lowest, np.finfo(float).eps)
    return along / size, shifts[best] + offset, correlation, gained


def vertex(values: np.ndarray, lowest: int | np.integer) -> float:
    """Fits a parabola to the lowest value and its neighbours; returns the offset of its minimum in steps."""
    if not 0 < lowest < len(values) - 1:
        return 0.0
    before, here, after = values[lowest - 1 : lowest + 2]
    curvature = before - 2 * here + after
    return float(0.5 * (before - after) / curvature) if curvature > 0 else 0.0


def away_from_ends(part: SampleIndex, farthest: int) -> Int[np.ndarray, " n"]:
    """Returns the indices of samples with `farthest` neighbours of the same part on either side."""
    places = np.arange(farthest, len(part) - farthest)
    return places[(part[places - farthest] == part[places]) & (part[places + farthest] == part[places])]


def check_derivatives(data: Trajectories, even: Smoothed) -> list[Finding]:
    """Checks that qd is the rate of q, and qdd the rate of qd, if the file has them; `even` is smooth(data, trim=0)."""
    findings = []
    part, moves = even.data.trajectory, data.q.std(axis=0) > 0
    derived = ("qd", even.data.qd, "dq/dt"), ("qdd", even.data.qdd, "d²q/dt²")
    for (key, own, formula), (_, other, name) in zip(derived, derived[::-1], strict=True):
        if key in data.estimated:
            continue
        measured = _at_times_of(data, even, getattr(data, key))
        inside = away_from_ends(part, 2)
        left, left_other = (
            1 - np.sum(x * measured[inside], axis=0) ** 2
            / np.maximum(np.sum(x**2, axis=0) * np.sum(measured[inside] ** 2, axis=0), TINY)
            for x in (own[inside], other[inside])
        )  # fmt: skip
        exchanged = ((left_other < 1 - ALIKE**2) & (left_other < EXCHANGED * left))[moves]
        if exchanged.size and exchanged.all():
            remedy = f"exchange qd and qdd, or {RATE_REMEDY}"
            findings += findings_of(("error", f"{key}-exchanged", True, f"{key} is {name}, not {formula}", remedy))
            continue
        farthest = max(2, min(round(FARTHEST * even.rate), 40, int(np.bincount(part).max()) // 8))
        factor, delay, correlation, gained = _match(measured, own, part, farthest)
        alike = (np.abs(correlation) > ALIKE) & moves
        # Noise in the derived signal lowers the least-squares factor, but noise in the measured one does not. The true
        # factor lies between the two regressions of one signal on the other.
        least = np.abs(factor)
        most = least / np.maximum(correlation**2, TINY)
        degrees, radians, milli, right = (
            alike & (least < unit * tolerance) & (unit < most * tolerance)
            for unit, tolerance in ((RADIAN, 1.05), (1 / RADIAN, 1.05), (1000.0, 1.05), (1.0, 1.15))
        )
        opposite = alike & (factor < 0)
        odd = alike & ~(degrees | radians | milli | opposite | right)
        late = alike & (np.abs(delay) > LATE) & (gained > 1.5)
        worst = max(delay[late], key=abs, default=0.0)
        delayed = f"up to {abs(worst) / even.rate * 1e3:.3g} ms {'late' if worst > 0 else 'early'}"
        ratios = ", ".join(f"{number:.3g}" for number in factor[odd])
        of = f"{key} of {{}}"
        findings += findings_of(
            ("error", f"{key}-unit", degrees, f"{of} is 57.3 times {formula}",
             f"convert {key} from degrees to radians"),
            ("error", f"{key}-unit", radians, f"{of} is {formula} / 57.3", "convert q from degrees to radians"),
            ("error", f"{key}-unit", milli, f"{of} is 1000 times {formula}", "give t in seconds"),
            ("error", f"{key}-sign", opposite, f"{of} has the opposite sign of {formula}",
             f"change the sign of {key} or q"),
            ("error", f"{key}-unit", odd, f"{of} is {ratios} times {formula}",
             f"check units and gear ratios, or {RATE_REMEDY}"),
            ("error", f"{key}-unlike", (np.abs(correlation) < UNLIKE) & moves, f"{of} does not follow {formula}",
             f"check the order of the columns, or {RATE_REMEDY}"),
            ("warning", f"{key}-delay", late, f"{of} is {delayed} relative to q", RATE_REMEDY),
        )  # fmt: skip
    return findings


def _at_times_of(data: Trajectories, even: Smoothed, values: np.ndarray) -> np.ndarray:
    """Interpolates columns of a log linearly at the times of its smoothed samples."""
    rows = np.empty((len(even.data.t), values.shape[1]))
    sources = {str(label): index for index, label in enumerate(data.label)}
    for index, label in enumerate(map(str, even.data.label)):
        source = sources.get(label, sources.get(label.rpartition(PART)[0]))
        here, there = even.data.trajectory == index, data.trajectory == source
        for column in range(values.shape[1]):
            rows[here, column] = np.interp(even.data.t[here], data.t[there], values[there, column])
    return rows
