"""Tests hypotheses about faults in torques: a wrong sign, exchanged columns, a delay and others.

A hypothesis is accepted if it predicts nearly all left-out blocks of time much better than the recorded log does.
Without a robot, the prior of the torques is an arbitrary energy with friction (`priors`), valid for arms of any
kinematics. A robot's file gives a narrower prior (`tree`). The fault with the most support is repaired, then the next.

Priors are Gaussian, so they include impossible robots. Repairs that need negative inertia or driving friction are
discarded. Torques of joints with significantly negative inertia have the wrong sign.
"""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.checks.channels import TURNS, Finding, away_from_ends, findings_of, vertex
from dln_jax.data.checks.priors import BLOCKS, SCALES, Build, Explanation, Hypothesis, any_energy, blocks_of, explain
from dln_jax.data.schema import Trajectories
from dln_jax.types import JointVector

DECISIVE = 15.0
"""Log likelihood ratio over all blocks for a decision: odds of three million to one."""
MOST_BLOCKS = 0.8
"""Fraction of blocks that must agree."""
BETTER = 0.8
"""A change of sign or order must lower the unexplained variance to this fraction. With a robot, all joints count, since
its parameters couple them; without one, the changed joints count."""
LESS_LATE = 0.95
"""The same for a delay."""
EXPLAINED = 0.02
"""Signs and order of the recorded torques are right if less than this fraction of each variance is unexplained."""
LATE = 0.2
"""Smallest delay reported, in samples."""
MOST_FAULTS = 3
SCANNED, ROUGHLY, CANDIDATES = 250, 3, 2
"""Ranking of single faults: equations, iterations, and the number of faults of each kind that are tested fully."""
INERTIAS = 8
"""Number of configurations for testing the sign of the inertias."""
NEGATIVE = -5.0
"""An inertia, their sum, or the power lost to friction counts as negative below this many standard deviations."""
TRUSTED = 0.8
"""Fraction of a torque's variance that must be predicted before its friction is reported."""
DRY = 0.02
"""Smallest dry friction reported, relative to the torque's standard deviation."""
SURE = 5.0
"""Dry friction must exceed zero by this many standard deviations."""
FEWER = 300
"""Number of equations used to compare degrees with radians."""


class Torques(NamedTuple):
    """Result of the examination of a log's torques."""

    recorded: Explanation
    """Explanation of the log as recorded."""
    repaired: Explanation
    """Explanation of the log with its faults repaired."""
    tried: Float[np.ndarray, " S"]
    """Delays tried, in samples."""
    loss: Float[np.ndarray, " S"]
    """Log likelihood ratio of no delay against every delay tried."""
    likely_delay: float
    """Delay with the lowest loss, in samples."""
    viscous: JointVector
    """N m s or N s/m."""
    coulomb: JointVector
    """N m or N."""
    coulomb_error: JointVector
    """Standard deviation of `coulomb`."""
    velocity_scale: JointVector
    """1/s or m/s: velocity scale of the smooth sign change of dry friction."""
    rest: Float[np.ndarray, "n d"]
    """Friction and noise: torques minus everything else that was explained."""

    @property
    def explained(self) -> JointVector:
        """Fraction of each torque's variance that is predicted in left-out blocks after repair."""
        return 1 - self.repaired.unexplained.mean(axis=0)

    @property
    def gain(self) -> str:
        """Gain of the repairs, as text."""
        before, after = (way.unexplained.mean() for way in (self.recorded, self.repaired))
        return f"unexplained in left-out blocks: {before:.2%} now, {after:.2%} if repaired"


def examine_torques(
    data: Trajectories,
    build: Build,
    *,
    farthest: int,
    equations: int,
    alone: bool = False,
    others: Callable[[Hypothesis], list[Hypothesis]] = lambda _: [],
) -> Torques | None:
    """Searches for wrong signs, exchanged columns, a delay and `others`; `None` with too few samples.

    Args:
        data: samples at equal steps, with sound rates.
        build: makes the prior.
        farthest: largest delay tried, in samples.
        equations: number n d of equations used.
        alone: whether the prior couples joints so weakly that a fault is judged by the joints it concerns.
        others: proposes further faults, as repaired logs.
    """
    log = _sampled(data, farthest, equations)
    if log is None:
        return None
    recorded = now = explain(log, build(log))
    loss, likely = _late(now, farthest)
    for _ in range(MOST_FAULTS):
        better = _better(now, build, farthest, others, alone=alone)
        if better is None:
            break
        now = better
    now = _with_positive_inertias(now, build)
    return Torques(recorded, now, np.arange(-farthest, farthest + 1.0), loss, likely, *_friction(now)[:-1])


def _sampled(data: Trajectories, farthest: int, equations: int) -> Hypothesis | None:
    """Selects samples for this number of equations, with room for the delay; `None` with too few."""
    d = data.degrees_of_freedom
    inside = away_from_ends(data.trajectory, farthest + 1)
    count = min(equations // d, len(inside))
    if count < 2 * BLOCKS:
        return None
    return Hypothesis(data, inside[np.linspace(0, len(inside) - 1, count).astype(int)], np.ones(d), tuple(range(d)))


def _late(now: Explanation, farthest: int) -> tuple[np.ndarray, float]:
    """Returns the loss of every delay at the same weights, and the best delay with subsample resolution."""
    trials = [now.log.torques(), *(now.log.torques(shift) for shift in range(-farthest, farthest + 1))]
    pull = now.inverse @ (np.stack([trial.ravel() for trial in trials], axis=1) - now.prior.mean[:, None])
    losses = []
    for block in blocks_of(*trials[0].shape):
        own = pull[block]
        losses.append(0.5 * np.sum(own * np.linalg.solve(now.inverse[np.ix_(block, block)], own), axis=0))
    losses = np.array(losses)
    loss = (losses - losses[:, :1])[:, 1:].sum(axis=0)
    best = int(np.argmin(loss))
    return loss, best - farthest + vertex(loss, best)


def _better(
    now: Explanation, build: Build, farthest: int, others: Callable[[Hypothesis], list[Hypothesis]], *, alone: bool
) -> Explanation | None:
    """Repairs the most likely fault of a log if it is decisive; `alone` judges by the affected joints."""
    log, d = now.log, len(now.log.order)
    flips = [log._replace(signs=np.where(np.arange(d) == joint, -log.signs, log.signs)) for joint in range(d)]
    exchanges = []
    for pair in itertools.combinations(range(d), 2):
        order = np.array(log.order)
        order[list(pair)] = order[list(pair[::-1])]
        exchanges.append(log._replace(order=tuple(order.tolist())))
    trials = [*_likeliest(log, flips, build), *_likeliest(log, exchanges, build), *others(log)]
    if log.delay == 0 and farthest > 0:
        _, delay = _late(now, farthest)
        if LATE < abs(delay) < farthest:
            trials.append(log._replace(delay=delay))
    better = []
    for trial in trials:
        then = explain(trial, build(trial))
        if not np.array_equal(trial.signs, log.signs):
            # Reversing one torque, or all torques coupled to it, explains a log equally well.
            then = _with_positive_inertias(then, build)
        limit = LESS_LATE if trial.delay != log.delay else BETTER
        concerned = (then.log.signs != log.signs) | (np.array(trial.order) != np.array(log.order))
        if concerned.any() and now.unexplained.mean(axis=0)[concerned].max() < EXPLAINED:
            continue
        if not alone or not concerned.any():  # a delay, the clock and the base concern all joints
            concerned = np.ones(d, bool)
        if decisive(now, then, limit, concerned):
            better.append(then)
    if better:
        credible = ~_impossible(now)
        better = [then for then in better if not np.any(_impossible(then) & credible)]
    return max(better, key=lambda then: then.densities.sum(), default=None)


def _likeliest(log: Hypothesis, trials: list[Hypothesis], build: Build) -> list[Hypothesis]:
    """Returns the few faults that are more likely than none, judged from fewer samples and rough weights."""
    if not trials:
        return []
    rows = log.rows[:: -(-len(log.rows) * len(log.order) // SCANNED)]
    prior = functools.cache(lambda order: build(log._replace(rows=rows, order=order)))

    def density(trial: Hypothesis) -> float:
        few = explain(trial._replace(rows=rows), prior(trial.order), iterations=ROUGHLY)
        return float(few.densities.sum())

    now, densities = density(log), np.array([density(trial) for trial in trials])
    return [trials[place] for place in np.argsort(densities)[::-1][:CANDIDATES] if densities[place] > now]


def decisive(now: Explanation, other: Explanation, limit: float, joints: np.ndarray) -> bool:
    """Whether another explanation is significantly better, and by enough to matter for these joints."""
    gains = other.densities - now.densities
    return bool(
        gains.sum() > DECISIVE
        and np.mean(gains > 0) >= MOST_BLOCKS
        and other.unexplained[:, joints].mean() < limit * now.unexplained[:, joints].mean()
    )


def _with_positive_inertias(now: Explanation, build: Build) -> Explanation:
    """Changes the signs of torques with significantly negative inertias, if the log fits equally well."""
    log = now.log
    if not np.ptp(log.torques(), axis=0).all():  # a torque that stays the same contradicts every robot
        return now
    inertias = _inertias(now)
    if min(*inertias, inertias.sum() / np.sqrt(len(inertias))) >= NEGATIVE:
        return now
    # Friction shows the sign of joints with little inertia.
    wrong = inertias + _friction(now)[-1] < 0
    trial = log._replace(signs=np.where(wrong, -log.signs, log.signs))
    turned = explain(trial, build(trial))
    return turned if turned.densities.sum() > now.densities.sum() - DECISIVE else now


def _impossible(now: Explanation) -> np.ndarray:
    """Joints [d] with a negative inertia or friction that drives them."""
    return np.minimum(_inertias(now), _friction(now)[-1]) < NEGATIVE


def _inertias(now: Explanation) -> JointVector:
    """Returns the mean inertia of every joint divided by its standard deviation."""
    q, d = now.log.states()[0], len(now.log.order)
    q = np.repeat(q[np.linspace(0, len(q) - 1, INERTIAS).astype(int)], d, axis=0)
    pushed = q, np.zeros_like(q), np.tile(np.eye(d), (INERTIAS, 1))
    diagonal = np.tile(np.eye(d * d)[:: d + 1], INERTIAS) / INERTIAS
    mean, shared, own, first = now.prior.inertias(pushed, diagonal)
    weights = now.weights[first : first + len(own)]
    with_log, alone = (np.tensordot(weights, np.array(parts), 1) for parts in (shared, own))
    known = alone - with_log @ now.inverse @ with_log.T
    return (mean + with_log @ now.pull) / np.sqrt(np.maximum(np.diag(known), 1e-12 * np.diag(alone) + 1e-300))


def _friction(now: Explanation) -> tuple[np.ndarray, ...]:
    """Returns viscous friction, dry friction, its error and velocity scale, the torques of friction and noise, and the
    lost power in standard deviations."""
    tau, qd = now.log.torques(), now.log.states()[1]
    n, d = tau.shape
    typical = np.maximum(qd.std(axis=0), 1e-12)
    rest = now.pull.reshape(n, d) * (now.weights[-d:] * np.maximum(tau.var(axis=0), 0.0))
    numbers = []
    for joint in range(d):
        columns, weight = now.prior.columns[joint - d], now.weights[joint - 2 * d]
        own = weight * (columns.T @ now.pull)
        rest[:, joint] += (columns @ own).reshape(n, d)[:, joint]
        spread = weight * np.eye(len(own)) - weight**2 * columns.T @ now.inverse @ columns
        dry = np.r_[0.0, np.ones(len(SCALES)), 0.0]
        lost = qd[:, joint] @ columns[joint::d]
        error, doubt = (np.sqrt(max(x @ spread @ x, 0.0)) for x in (dry, lost))
        numbers.append([own[0] / typical[joint], own @ dry, error, own @ lost / max(doubt, 1e-300)])
    viscous, coulomb, error, power = np.array(numbers).T
    return viscous, coulomb, error, SCALES[0] * typical, rest, power


def check_torques(torques: Torques, *, friction_stated: bool, with_robot: bool) -> list[Finding]:
    """Turns the examination of torques into findings."""
    log = torques.repaired.log
    columns = ", ".join(str(source + 1) for source in log.order)
    step = 1e3 * float(np.median(np.diff(log.data.t)[np.diff(log.data.trajectory) == 0]))
    late = f"{abs(log.delay) * step:.3g} ms {'late' if log.delay > 0 else 'early'}"
    findings = findings_of(
        ("error", "tree-sign" if with_robot else "torque-sign", log.signs < 0,
         f"the torque of {{}} has the wrong sign ({torques.gain})", "change the sign of that tau or that q"),
        ("error", "order", np.array(log.order) != np.arange(len(log.order)),
         f"the torques of {{}} are exchanged: columns {columns} of tau fit q ({torques.gain})",
         "order the columns of tau like the columns of q"),
        ("warning", "delay", log.delay != 0, f"torques are {late} relative to positions ({torques.gain})",
         "shift one of them in time, or correct the clock of the log"),
    )  # fmt: skip
    if findings or friction_stated:
        return findings
    least = np.maximum(DRY * log.torques().std(axis=0), SURE * torques.coulomb_error)
    sure = (torques.explained > TRUSTED) & (torques.coulomb > least)
    sizes = ", ".join(f"{dry:.2g}" for dry in torques.coulomb[sure])
    return findings_of(
        ("note", "friction", sure, f"friction is seen at {{}} (dry: about {sizes})",
         'state it: --needs \'{"joints": [...], "joint_friction": ["viscous", "coulomb"]}\'')
    )  # fmt: skip


def check_degrees(data: Trajectories, joints: tuple[str, ...], *, driven: bool) -> list[Finding]:
    """Reports very large angles, which may be in degrees or on the motor's side."""
    largest = np.abs(data.q).max(axis=0)
    large = np.array([kind == "revolute" for kind in joints]) & (largest > TURNS)
    if not large.any():
        return []
    factor = np.where(large, np.pi / 180, 1.0)

    def unexplained(data: Trajectories) -> float:
        log = _sampled(data, 0, FEWER)
        return np.nan if log is None else float(explain(log, any_energy(joints)(log)).unexplained.mean())

    converted = data._replace(q=data.q * factor, qd=data.qd * factor, qdd=data.qdd * factor)
    wrong = (driven and unexplained(converted) < 0.7 * unexplained(data)) or largest.max() >= 10 * TURNS
    reach = f"q of {{}} goes to {largest.max():.3g}"
    return findings_of(
        ("error", "q-unit", large & wrong, f"{reach}, far beyond two turns",
         "convert to radians if these are degrees, or divide by the gear ratio if they are the motor's"),
        ("note", "q-unit", large & (not wrong), f"{reach} rad, which is {largest.max() / 2 / np.pi:.1f} turns",
         "ignore this if the joint turns without limit; else convert from degrees, or divide by the gear ratio"),
    )  # fmt: skip
