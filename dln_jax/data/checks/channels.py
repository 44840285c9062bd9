"""Checks of single channels: what never moves, moves in steps, or ends at a limit."""

import numpy as np

from dln_jax.data.checks.findings import Finding, named
from dln_jax.data.encoders.noise import step_of
from dln_jax.data.schema import Trajectories

TURNS = 4 * np.pi
"""rad: two turns, beyond which an angle of an arm is looked at twice."""
WEAK = 0.03
"""Of the median joint's velocity, below which a joint is hardly moved."""
COARSE = 3e-4
"""Steps of an encoder in rad that are worth a word: 1/20000 of a turn."""
RUN = 4
"""Samples at the very same extreme value that make a flat top."""
SHARE = 2e-3
"""Of all samples, in flat tops, from which a channel is called saturated."""
ABRUPT = 0.5
"""Of the typical step between samples: by so much a channel moves into or out of a limit that cuts it off."""


def check_channels(data: Trajectories, rates: np.ndarray | None) -> list[Finding]:
    """Joints that do not move, torques that do not vary, steps and flat tops; `rates` are qd of the filtered q."""
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
        # A joint without a motor has zero torque, and a passive system has none at all.
        constant = np.array([joint for joint in constant if data.tau[0, joint] != 0], int)
        if len(constant):
            said = f"the torque of {named(constant)} is constant"
            remedy = "see that the right channel was logged"
            found.append(Finding("warning", "constant-torque", said, remedy, tuple(map(int, constant))))
        found += _saturated(data, "tau", "torque", "keep away from the motors' limits, or leave those samples out")
    found += _saturated(data, "q", "position", "see whether it is at its stop or the log is clipped; leave that out")
    steps = step_of(data.q)
    coarse = np.flatnonzero(steps > COARSE)
    if len(coarse):
        said = f"q of {named(coarse)} comes in steps of up to {steps.max():.2g}"
        remedy = "filter before rates are derived: --cutoff auto, or smooth()"
        found.append(Finding("note", "quantisation", said, remedy, tuple(map(int, coarse))))
    return found


def _saturated(data: Trajectories, key: str, word: str, remedy: str) -> list[Finding]:
    shares = [flat_share(channel, data.trajectory) for channel in getattr(data, key).T]
    joints = [joint for joint, share in enumerate(shares) if share > SHARE]
    if not joints:
        return []
    said = f"the {word} of {named(joints)} is cut off flat in up to {max(shares):.1%} of the samples"
    return [Finding("warning", f"saturation-{key}", said, remedy, tuple(joints))]


def flat_share(channel: np.ndarray, trajectory: np.ndarray) -> float:
    """Share of the samples in runs at the largest or smallest value that are entered or left abruptly.

    A smooth extreme is approached ever more slowly, and a joint at rest stays where it was; a limit cuts a motion off.
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
