"""Checks single channels: motionless joints, coarse steps, spikes and saturation."""

import numpy as np

from dln_jax.data.checks.findings import Finding, named
from dln_jax.data.encoders.sampling import step_of
from dln_jax.data.schema import Trajectories

TURNS = 4 * np.pi
"""rad: two turns; larger angles of an arm are suspicious."""
WEAK = 0.03
"""Fraction of the median joint's velocity below which a joint is hardly excited."""
COARSE = 3e-4
"""rad: smallest encoder step reported, 1/20000 of a turn."""
RUN = 4
"""Samples at exactly the same extreme value that make a flat top."""
SHARE = 2e-3
"""Fraction of samples in flat tops above which a channel counts as saturated."""
SPIKE = 4.0
"""A spike exceeds the usual change of the channel over two samples by this factor."""
CLEAR = 3.0
"""A spike exceeds the range of its four neighbours by this factor."""
ABRUPT = 0.5
"""A channel enters or leaves a clipping limit by more than this fraction of the typical step."""


def check_channels(data: Trajectories, rates: np.ndarray | None) -> list[Finding]:
    """Checks for still joints, constant torques, spikes, steps and flat tops; `rates` are qd of the filtered q."""
    found = []
    still = np.flatnonzero(np.ptp(data.q, axis=0) <= 1e-9 * max(1.0, np.abs(data.q).max()))
    if len(still):
        said = f"{named(still)} never move{'s' * (len(still) == 1)}"
        remedy = "move it in some trajectories, or leave it out of q: its inertia and friction cannot be learned"
        found.append(Finding("warning", "unexcited", said, remedy, tuple(map(int, still))))
    if rates is not None:
        speed = rates.std(axis=0)
        weak = np.setdiff1d(np.flatnonzero(speed < WEAK * np.median(speed)), still)
        if len(weak):
            said = f"{named(weak)} move{'s' * (len(weak) == 1)} less than {WEAK:.0%} as fast as others"
            remedy = "excite it more: what it does is hardly seen"
            found.append(Finding("warning", "unexcited", said, remedy, tuple(map(int, weak))))
    if "tau" not in data.estimated:
        constant = np.flatnonzero(np.ptp(data.tau, axis=0) == 0)
        found += _dead(data, still)
        # A joint without a motor has zero torque; a passive system has only such joints.
        constant = np.array([joint for joint in constant if data.tau[0, joint] != 0], int)
        if len(constant):
            said = f"the torque of {named(constant)} is constant"
            remedy = "see that the right channel was logged"
            found.append(Finding("warning", "constant-torque", said, remedy, tuple(map(int, constant))))
        found += _saturated(data, "tau", "torque", "keep away from the motors' limits, or leave those samples out")
    found += _spiky(data)
    found += _saturated(data, "q", "position", "see whether it is at its stop or the log is clipped; leave that out")
    steps = step_of(data.q)
    coarse = np.flatnonzero(steps > COARSE)
    if len(coarse):
        said = f"q of {named(coarse)} comes in steps of up to {steps.max():.2g}"
        remedy = "filter before rates are derived: --cutoff auto, or smooth()"
        found.append(Finding("note", "quantisation", said, remedy, tuple(map(int, coarse))))
    return found


def _dead(data: Trajectories, still: np.ndarray) -> list[Finding]:
    """Reports torques that are always zero although the joint moves and no actuation matrix excludes a motor."""
    needs = data.needs
    driven = np.ones(data.degrees_of_freedom, bool)
    if needs is not None and needs.actuation is not None:
        driven = np.any(np.asarray(needs.actuation) != 0, axis=1)
    dead = np.setdiff1d(np.flatnonzero(driven & ~data.tau.any(axis=0)), still)
    if not len(dead):
        return []
    said = (
        f"the torque of {named(dead)} is zero in all samples, although {'it moves' if len(dead) == 1 else 'they move'}"
    )
    remedy = "log that torque; or state in needs, by actuation, that there is no motor"
    return [Finding("warning", "dead-torque", said, remedy, tuple(map(int, dead)))]


def _spiky(data: Trajectories) -> list[Finding]:
    """Reports single samples far from both neighbours, which agree with each other."""
    found = []
    for key, word in (("q", "position"), ("tau", "torque")):
        if key in data.estimated:
            continue
        counts = spikes(getattr(data, key), data.trajectory).sum(axis=0)
        joints = np.flatnonzero(counts)
        if len(joints):
            said = f"the {word} of {named(joints)} has {int(counts.sum())} spike(s)"
            remedy = "leave those samples out" + (", or let identify weigh them by --robust" if key == "tau" else "")
            found.append(Finding("warning", "spikes", said, remedy, tuple(map(int, joints))))
    return found


def spikes(values: np.ndarray, trajectory: np.ndarray) -> np.ndarray:
    """Mask of samples [N, k] that leave a channel and return at once, by much more than it ever changes otherwise.

    A sample is compared with the median of the two neighbours on either side. Upper quartiles of that error and of the
    neighbours' range over all samples give the usual change.
    """
    found = np.zeros(values.shape, bool)
    inside = np.flatnonzero(trajectory[4:] == trajectory[:-4]) + 2
    if len(inside) < 50:
        return found
    near = values[inside - 1], values[inside + 1]
    wide = values[inside - 2], values[inside + 2]
    middle = np.median([*near, *wide], axis=0)
    spread = np.max([*near, *wide], axis=0) - np.min([*near, *wide], axis=0)
    error = np.abs(values[inside] - middle)
    usual = np.quantile(error, 0.75, axis=0) + np.quantile(spread, 0.75, axis=0)
    found[inside] = (error > SPIKE * usual) & (error > CLEAR * spread) & (error > 0)
    return found


def _saturated(data: Trajectories, key: str, word: str, remedy: str) -> list[Finding]:
    shares = [flat_share(channel, data.trajectory) for channel in getattr(data, key).T]
    joints = [joint for joint, share in enumerate(shares) if share > SHARE]
    if not joints:
        return []
    said = f"the {word} of {named(joints)} is cut off flat in up to {max(shares):.1%} of the samples"
    return [Finding("warning", f"saturation-{key}", said, remedy, tuple(joints))]


def flat_share(channel: np.ndarray, trajectory: np.ndarray) -> float:
    """Fraction of samples in runs at the largest or smallest value that are entered or left abruptly.

    A smooth extreme is approached ever more slowly and a joint at rest does not move, whereas a limit cuts a motion
    off.
    """
    size = np.ptp(channel)
    if size == 0:
        return 0.0
    same = np.diff(trajectory) == 0
    moves = np.abs(np.diff(channel))
    moving = moves[same & (moves > 1e-9 * size)]
    typical = np.median(moving) if len(moving) else np.inf
    count = 0
    for extreme in (channel.max(), channel.min()):
        at = np.abs(channel - extreme) <= 1e-9 * size
        edges = np.flatnonzero(np.diff(np.r_[0, at.astype(int), 0]))
        for first, last in edges.reshape(-1, 2):
            if last - first < RUN:
                continue
            beside = [place for place in (first - 1, last - 1) if 0 <= place < len(moves) and same[place]]
            if any(moves[place] > ABRUPT * typical for place in beside):
                count += last - first
    return count / len(channel)
