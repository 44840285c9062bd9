"""Tests hypotheses about faults in torques: a wrong sign, exchanged columns, a delay and others.

A hypothesis is accepted if it predicts left-out blocks of time much better than the log as recorded, in nearly all
blocks. Without a robot, the torques have the prior of an arbitrary energy with friction (`energies`), valid for arms
of any kinematics; a robot's file gives a narrower prior (`tree`). The best supported fault is repaired, then the next.

Priors are Gaussian, so they also hold impossible robots. A repair that needs negative inertia or friction that drives
is none, and joints whose inertia is negative beyond doubt have torques of the wrong sign.
"""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.checks import evidence
from dln_jax.data.checks.derivatives import away_from_ends, vertex
from dln_jax.data.checks.energies import SCALES, Build, States
from dln_jax.data.checks.evidence import Explanation, Prior
from dln_jax.data.schema import Trajectories

DECISIVE = 15.0
"""Log likelihood ratio over all blocks that is required to decide: odds of three million to one."""
MOST_BLOCKS = 0.8
"""Fraction of blocks that must agree."""
BETTER = 0.8
"""A change of sign or order must lower the unexplained variance to this fraction. With a robot the variance is that of
all joints, since its parameters couple them; without one it is that of the joints whose torques change."""
LESS_LATE = 0.95
"""The same for a delay."""
EXPLAINED = 0.02
"""Signs and order of torques are right if less than this fraction of each one's variance is unexplained as recorded."""
LATE = 0.2
"""Smallest delay reported, in samples."""
MOST_FAULTS = 3
SCANNED, ROUGHLY, CANDIDATES = 250, 3, 2
"""Ranking of single faults: equations, iterations, and the number of faults of a kind that are then tested fully."""
INERTIAS = 8
"""Number of configurations for testing the sign of the inertias."""
NEGATIVE = -5.0
"""An inertia, the sum of them over joints, or the power lost to friction is negative if it is below this many standard
deviations."""


class Log(NamedTuple):
    """A log and the faults repaired in it."""

    data: Trajectories
    rows: np.ndarray
    """Indices of the samples used [n]."""
    signs: Float[np.ndarray, " d"]
    """-1 for torques with the wrong sign."""
    order: tuple[int, ...]
    """Column of tau for every joint."""
    delay: float = 0.0
    """Delay of the torques in samples."""
    speed: float = 1.0
    """True speed of the joints, relative to the speed that t implies."""
    gravity: np.ndarray | None = None
    """m/s² [3]; `None` for the stated gravity."""

    def states(self) -> States:
        """q, qd and qdd at the rows' times, shifted back by the delay with linear interpolation."""
        whole = int(np.floor(-self.delay))
        part, first = -self.delay - whole, self.rows + whole

        def at(values: np.ndarray) -> np.ndarray:
            return (1 - part) * values[first] + part * values[first + 1]

        return at(self.data.q), self.speed * at(self.data.qd), self.speed**2 * at(self.data.qdd)

    def torques(self, shift: int = 0) -> np.ndarray:
        """Torques of the joints with repaired signs and order, `shift` samples later."""
        return self.data.tau[self.rows + shift][:, list(self.order)] * self.signs


class Torques(NamedTuple):
    """Result of the examination of a log's torques."""

    explanation: Explanation
    """Explanation of the log as recorded."""
    log: Log
    """The log with its faults repaired."""
    repaired: Explanation
    """Explanation of the repaired log."""
    tried: Float[np.ndarray, " S"]
    """Delays tried, in samples."""
    loss: Float[np.ndarray, " S"]
    """Log likelihood ratio of no delay against every delay tried."""
    likely_delay: float
    """Delay with the lowest loss, in samples."""
    viscous: Float[np.ndarray, " d"]
    """N m s or N s/m."""
    coulomb: Float[np.ndarray, " d"]
    """N m or N."""
    coulomb_error: Float[np.ndarray, " d"]
    """Standard deviation of `coulomb`."""
    velocity_scale: Float[np.ndarray, " d"]
    """1/s or m/s: velocity scale of the smooth sign change of dry friction."""
    rest: Float[np.ndarray, "n d"]
    """Friction and noise: torques minus everything else that was explained."""

    @property
    def rows(self) -> np.ndarray:
        """Indices of the samples used."""
        return self.log.rows

    @property
    def explained(self) -> Float[np.ndarray, " d"]:
        """Fraction of each torque's variance that is predicted in left-out blocks after repair."""
        return 1 - self.repaired.unexplained.mean(axis=0)

    @property
    def gain(self) -> str:
        """Gain of the repairs, as text."""
        before, after = (way.unexplained.mean() for way in (self.explanation, self.repaired))
        return f"unexplained in left-out blocks: {before:.2%} now, {after:.2%} if repaired"


def examine_torques(
    data: Trajectories,
    build: Build,
    *,
    farthest: int,
    equations: int,
    alone: bool = False,
    faults: bool = True,
    others: Callable[[Log], list[Log]] = lambda _: [],
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
    d = data.degrees_of_freedom
    inside = away_from_ends(data.trajectory, farthest + 1)
    count = min(equations // d, len(inside))
    if count < 2 * evidence.BLOCKS:
        return None
    rows = inside[np.linspace(0, len(inside) - 1, count).astype(int)]
    log = Log(data, rows, np.ones(d), tuple(range(d)))
    first = now = _explained(log, build)
    loss, likely = _late(log, build, now, farthest)
    for _ in range(MOST_FAULTS if faults else 0):
        better = _better(log, build, now, farthest, others, alone=alone)
        if better is None:
            break
        log, now = better
    if faults:
        log, now = _with_positive_inertias(log, build, now)
    return Torques(
        first, log, now, np.arange(-farthest, farthest + 1.0), loss, likely, *_friction(log, build, now)[:-1]
    )


def _explained(log: Log, build: Build) -> Explanation:
    tau = log.torques()
    return evidence.explain(build(log.states(), tau, log.gravity), tau)


def _late(log: Log, build: Build, now: Explanation, farthest: int) -> tuple[np.ndarray, float]:
    """Loss of every delay, and the best delay with subsample resolution."""
    tau = log.torques()
    trials = [tau, *(log.torques(shift) for shift in range(-farthest, farthest + 1))]
    loss = -evidence.screened(now, build(log.states(), tau, log.gravity), trials)[:, 1:].sum(axis=0)
    best = int(np.argmin(loss))
    return loss, best - farthest + vertex(loss, best)


def _better(
    log: Log, build: Build, now: Explanation, farthest: int, others: Callable[[Log], list[Log]], *, alone: bool
) -> tuple[Log, Explanation] | None:
    """The log with its likeliest fault repaired, if that is decisive; `alone` judges by the joints concerned."""
    d = len(log.order)
    flips = [log._replace(signs=np.where(np.arange(d) == joint, -log.signs, log.signs)) for joint in range(d)]
    exchanges = []
    for pair in itertools.combinations(range(d), 2):
        order = np.array(log.order)
        order[list(pair)] = order[list(pair[::-1])]
        exchanges.append(log._replace(order=tuple(order.tolist())))
    trials = [*_likeliest(log, flips, build), *_likeliest(log, exchanges, build), *others(log)]
    if log.delay == 0 and farthest > 0:
        _, delay = _late(log, build, now, farthest)
        if LATE < abs(delay) < farthest:
            trials.append(log._replace(delay=delay))
    better: list[tuple[Log, Explanation]] = []
    for trial in trials:
        explained = _explained(trial, build)
        if not np.array_equal(trial.signs, log.signs):
            # Turning one torque or all those coupled to it explains a log alike.
            trial, explained = _with_positive_inertias(trial, build, explained)
        limit = LESS_LATE if trial.delay != log.delay else BETTER
        concerned = (trial.signs != log.signs) | (np.array(trial.order) != np.array(log.order))
        if concerned.any() and now.unexplained.mean(axis=0)[concerned].max() < EXPLAINED:
            continue
        if not alone or not concerned.any():  # a delay, the clock and the base concern all joints
            concerned = np.ones(d, bool)
        if decisive(now, explained, limit, concerned):
            better.append((trial, explained))
    if better:
        credible = ~_impossible(log, build, now)
        better = [(trial, then) for trial, then in better if not np.any(_impossible(trial, build, then) & credible)]
    return max(better, key=lambda pair: pair[1].densities.sum(), default=None)


def _likeliest(log: Log, trials: list[Log], build: Build) -> list[Log]:
    """The few faults that are likelier than the log as recorded, judged from fewer samples and rough weights."""
    if not trials:
        return []
    few = -(-len(log.rows) * len(log.order) // SCANNED)
    log = log._replace(rows=log.rows[::few])
    states = log.states()

    @functools.cache
    def prior(order: tuple[int, ...]) -> Prior:
        return build(states, log._replace(order=order).torques(), log.gravity)

    def density(trial: Log) -> float:
        tau = trial._replace(rows=log.rows).torques()
        return float(evidence.explain(prior(trial.order), tau, iterations=ROUGHLY).densities.sum())

    now, densities = density(log), np.array([density(trial) for trial in trials])
    return [trials[place] for place in np.argsort(densities)[::-1][:CANDIDATES] if densities[place] > now]


def decisive(now: Explanation, other: Explanation, limit: float, joints: np.ndarray) -> bool:
    """Whether another explanation is better beyond doubt, and by enough to matter for these joints."""
    gains = other.densities - now.densities
    return bool(
        gains.sum() > DECISIVE
        and np.mean(gains > 0) >= MOST_BLOCKS
        and other.unexplained[:, joints].mean() < limit * now.unexplained[:, joints].mean()
    )


def _with_positive_inertias(log: Log, build: Build, now: Explanation) -> tuple[Log, Explanation]:
    """The log with the signs of torques changed where inertias are negative beyond doubt, if that fits as well."""
    if not np.ptp(log.torques(), axis=0).all():  # a torque that stays the same contradicts every robot
        return log, now
    inertias = _inertias(log, build, now)
    if min(*inertias, inertias.sum() / np.sqrt(len(inertias))) >= NEGATIVE:
        return log, now
    # Friction shows the sign of joints with little inertia.
    wrong = inertias + _friction(log, build, now)[-1] < 0
    trial = log._replace(signs=np.where(wrong, -log.signs, log.signs))
    explained = _explained(trial, build)
    return (trial, explained) if explained.densities.sum() > now.densities.sum() - DECISIVE else (log, now)


def _impossible(log: Log, build: Build, now: Explanation) -> np.ndarray:
    """Joints [d] with a negative inertia or friction that drives them."""
    return np.minimum(_inertias(log, build, now), _friction(log, build, now)[-1]) < NEGATIVE


def _inertias(log: Log, build: Build, now: Explanation) -> Float[np.ndarray, " d"]:
    """Mean inertia of every joint divided by its standard deviation."""
    states = log.states()
    d = len(log.order)
    q = np.repeat(states[0][np.linspace(0, len(states[0]) - 1, INERTIAS).astype(int)], d, axis=0)
    pushed = q, np.zeros_like(q), np.tile(np.eye(d), (INERTIAS, 1))
    diagonal = np.tile(np.eye(d * d)[:: d + 1], INERTIAS) / INERTIAS
    mean, shared, own, first = build(states, log.torques(), log.gravity).inertias(pushed, diagonal)
    weights = now.weights[first : first + len(own)]
    with_log, alone = (np.tensordot(weights, np.array(parts), 1) for parts in (shared, own))
    known = alone - with_log @ now.inverse @ with_log.T
    return (mean + with_log @ now.pull) / np.sqrt(np.maximum(np.diag(known), 1e-12 * np.diag(alone) + 1e-300))


def _friction(log: Log, build: Build, now: Explanation) -> tuple[np.ndarray, ...]:
    """Viscous and dry friction, the error of the latter, its velocity scale, torques of friction and noise only, and
    the power lost in standard deviations."""
    tau, (_, qd, _) = log.torques(), log.states()
    n, d = tau.shape
    prior = build(log.states(), tau, log.gravity)
    start = len(prior.parts) + len(prior.columns) - d
    typical = np.maximum(qd.std(axis=0), 1e-12)
    noise = now.weights[len(prior.parts) + len(prior.columns) :] * np.maximum(tau.var(axis=0), 0.0)
    rest, numbers = now.pull.reshape(n, d) * noise, []
    for joint in range(d):
        columns, weight = prior.columns[len(prior.columns) - d + joint], now.weights[start + joint]
        own = weight * (columns.T @ now.pull)
        rest[:, joint] += (columns @ own).reshape(n, d)[:, joint]
        spread = weight * np.eye(len(own)) - weight**2 * columns.T @ now.inverse @ columns
        dry = np.r_[0.0, np.ones(len(SCALES)), 0.0]
        lost = qd[:, joint] @ columns[joint::d]
        numbers.append([own[0] / typical[joint], own @ dry, *(np.sqrt(max(x @ spread @ x, 0.0)) for x in (dry, lost))])
        numbers[-1][-1] = own @ lost / max(numbers[-1][-1], 1e-300)
    viscous, coulomb, error, power = np.array(numbers).T
    return viscous, coulomb, error, SCALES[0] * typical, rest, power
