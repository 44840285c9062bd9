"""Checks of the sampling times and of single channels: motionless joints, coarse steps, spikes and saturation."""

import numpy as np

from dln_jax.data.checks.findings import Finding, on_joints
from dln_jax.data.encoders.sampling import step_of, timing
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import LEAST_TRAJECTORIES

JITTER = 0.05
"""Largest standard deviation of the steps, relative to the step."""
SLOWEST = 1.0
"""Hz: at a lower rate t is hardly in seconds."""
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
"""A joint moves if it is faster than the first multiple of its root mean square speed; zero torques in a larger share
of such samples than the second are reported."""
FILTER = "interpolate to equal steps with smooth() or --cutoff auto"


def check_times(data: Trajectories) -> list[Finding]:
    """Checks rate, jitter, gaps and the number of trajectories for a split."""
    counts = np.unique(data.trajectory, return_counts=True)[1]
    few = f"the number of trajectories is {len(counts)}; a split by trajectory needs {LEAST_TRAJECTORIES}"
    split = Finding("warning", "split", few, "record more, or cut the log in time and number the parts")
    cases = [(len(counts) < LEAST_TRAJECTORIES, split)]
    if counts.max() > 1:
        rate, jitter, gaps, longest, rates = timing(data.t, data.trajectory)
        step = f"{1 / rate:.3g} s"
        gapped = f"t has {gaps} gap(s): the longest step is {longest:.3g} s, the typical one {step}"
        unequal = f"trajectories are sampled at {rates.min():.4g} to {rates.max():.4g} Hz"
        in_seconds = "give t in seconds if it is in milliseconds or ticks"
        cut = "cut the log at gaps, as smooth() does; rates across them are guesses"
        cases += [
            (rate < SLOWEST, Finding("error", "time-unit", f"samples are {step} apart", in_seconds)),
            (gaps > 0, Finding("note", "gaps", gapped, cut)),
            (jitter > JITTER, Finding("warning", "jitter", f"time steps vary by {jitter:.0%}", FILTER)),
            (np.ptp(rates) > UNEQUAL * rate, Finding("note", "rates", unequal, FILTER)),
        ]
    return [finding for holds, finding in cases if holds]


def check_channels(data: Trajectories, rates: np.ndarray | None) -> list[Finding]:
    """Checks for still joints, constant torques, spikes, steps and flat tops; `rates` are qd of the filtered q."""
    still = np.ptp(data.q, axis=0) <= 1e-9 * max(1.0, np.abs(data.q).max())
    speed = np.full(len(still), np.inf) if rates is None else rates.std(axis=0)
    weak = (speed < WEAK * np.median(speed)) & ~still
    steps = step_of(data.q)
    findings = on_joints(
        "warning", "unexcited", still, f"{{}} never {'moves' if still.sum() == 1 else 'move'}",
        "move it in some trajectories, or leave it out of q: its inertia and friction cannot be learned",
    )  # fmt: skip
    findings += on_joints(
        "warning", "unexcited", weak,
        f"{{}} {'moves' if weak.sum() == 1 else 'move'} less than {WEAK:.0%} as fast as others",
        "excite it more: the log hardly shows its dynamics",
    )  # fmt: skip
    if "tau" not in data.estimated:
        # A joint without a motor has zero torque; a passive system has only such joints.
        constant = (np.ptp(data.tau, axis=0) == 0) & (data.tau[0] != 0)
        needs = data.needs
        driven = np.ones(len(still), bool)
        if needs is not None and needs.actuation is not None:
            driven = np.any(np.asarray(needs.actuation) != 0, axis=1)
        dead = driven & ~data.tau.any(axis=0) & ~still
        findings += on_joints(
            "warning", "dead-torque", dead,
            f"the torque of {{}} is zero in all samples, although {'it moves' if dead.sum() == 1 else 'they move'}",
            "log that torque; or state in needs, by actuation, that the joint has no motor",
        )  # fmt: skip
        fast = np.abs(data.qd) > FAST * np.sqrt(np.mean(data.qd**2, axis=0))
        zero = np.sum((data.tau == 0) & fast, axis=0) / np.maximum(fast.sum(axis=0), 1)
        hidden = driven & (zero > HIDDEN) & ~dead & ~still
        findings += on_joints(
            "warning", "hidden-torque", hidden,
            f"the torque of {{}} is exactly zero in up to {zero[hidden].max(initial=0.0):.0%} of the samples in which "
            f"{'it moves' if hidden.sum() == 1 else 'they move'}",
            "unless the motors were off, the drivers hide small torques: leave such joints out (--lock)",
        )  # fmt: skip
        findings += on_joints(
            "warning", "constant-torque", constant, "the torque of {} is constant",
            "check that the right channel was logged",
        )  # fmt: skip
        findings += _saturated(data, "tau", "torque", "avoid the limits of the motors, or leave those samples out")
    findings += _spiky(data, "q", "position", "leave those samples out")
    findings += _spiky(data, "tau", "torque", "leave those samples out, or let identify weigh them by --robust")
    findings += _saturated(
        data, "q", "position", "check whether it is at its stop or the log is clipped; leave those samples out"
    )
    findings += on_joints(
        "note", "quantisation", steps > COARSE, f"q of {{}} comes in steps of up to {steps.max():.2g}",
        "filter before rates are derived: --cutoff auto, or smooth()",
    )  # fmt: skip
    return findings


def _spiky(data: Trajectories, key: str, word: str, remedy: str) -> list[Finding]:
    """Reports single samples far from both neighbours, which agree with each other."""
    if key in data.estimated:
        return []
    counts = spikes(getattr(data, key), data.trajectory).sum(axis=0)
    return on_joints("warning", "spikes", counts > 0, f"the {word} of {{}} has {int(counts.sum())} spike(s)", remedy)


def spikes(values: np.ndarray, trajectory: np.ndarray) -> np.ndarray:
    """Mask of samples [N, k] that leave a channel and return at once, by much more than it ever changes otherwise.

    A sample is compared with the median of the two neighbours on either side. Upper quartiles of that error and of the
    neighbours' range over all samples give the usual change.
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


def _saturated(data: Trajectories, key: str, word: str, remedy: str) -> list[Finding]:
    shares = np.array([flat_share(channel, data.trajectory) for channel in getattr(data, key).T])
    observation = f"the {word} of {{}} is cut off flat in up to {shares.max():.1%} of the samples"
    return on_joints("warning", f"saturation-{key}", shares > SHARE, observation, remedy)


def flat_share(channel: np.ndarray, trajectory: np.ndarray) -> float:
    """Fraction of samples in runs at the largest or smallest value that are entered or left abruptly.

    A smooth extreme is approached ever more slowly and a joint at rest does not move; a limit cuts a motion off.
    """
    size = np.ptp(channel)
    if size == 0:
        return 0.0
    same = np.diff(trajectory) == 0
    moves = np.abs(np.diff(channel))
    moving = moves[same & (moves > 1e-9 * size)]
    typical = np.median(moving) if len(moving) else np.inf
    # A smooth extreme of at least RUN samples in steps is entered and left by fewer than three steps.
    abrupt = max(ABRUPT * typical, 3 * float(step_of(channel[:, None])[0]))
    count = 0
    for extreme in (channel.max(), channel.min()):
        at = np.abs(channel - extreme) <= 1e-9 * size
        edges = np.flatnonzero(np.diff(np.r_[0, at.astype(int), 0]))
        for first, last in edges.reshape(-1, 2):
            beside = [place for place in (first - 1, last - 1) if 0 <= place < len(moves) and same[place]]
            if last - first >= RUN and any(moves[place] > abrupt for place in beside):
                count += last - first
    return count / len(channel)
