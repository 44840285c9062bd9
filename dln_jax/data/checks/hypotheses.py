"""Tests hypotheses about faults in torques: a wrong sign, exchanged columns, a delay and others.

A hypothesis is accepted if it predicts left-out blocks of time much better than the log as recorded, in nearly all
blocks. Without a robot, the torques have the prior of an arbitrary energy with friction (`energies`), valid for arms
of any kinematics; a robot's file gives a narrower prior (`tree`). The best supported fault is repaired, then the next.
"""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.checks import evidence
from dln_jax.data.checks.derivatives import away_from_ends, vertex
from dln_jax.data.checks.energies import SCALES, Build, Parts, States, covariances, sizes_of
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
LATE = 0.2
"""Smallest delay reported, in samples."""
MOST_FAULTS = 3
SCANNED, ROUGHLY, CANDIDATES = 250, 3, 2
"""Ranking of single faults: equations, iterations, and the number of faults of a kind that are then tested fully."""
INERTIAS = 8
"""Number of configurations for testing the sign of the inertias."""
NEGATIVE = -5.0
"""Inertias are negative if their sum over joints is below this many standard deviations."""


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
    ambiguous: bool,
    faults: bool = True,
    others: Callable[[Log], list[Log]] = lambda _: [],
) -> Torques | None:
    """Searches for wrong signs, exchanged columns, a delay and `others`; `None` with too few samples.

    Args:
        data: samples at equal steps, with sound rates.
        build: makes the prior.
        farthest: largest delay tried, in samples.
        equations: number n d of equations used.
        ambiguous: whether the prior fits any robot. It then allows negative inertias, so the common sign of all torques
            is tested too, and couples joints so weakly that a fault is judged by the joints it concerns.
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
        better = _better(log, build, now, farthest, others, alone=ambiguous)
        if better is None:
            break
        log, now = better
    if ambiguous and _inertias(log, now) < NEGATIVE:
        log = log._replace(signs=-log.signs)
    return Torques(first, log, now, np.arange(-farthest, farthest + 1.0), loss, likely, *_friction(log, build, now))


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
        limit = LESS_LATE if trial.delay != log.delay else BETTER
        concerned = (trial.signs != log.signs) | (np.array(trial.order) != np.array(log.order))
        if not alone or not concerned.any():  # a delay, the clock and the base concern all joints
            concerned = np.ones(d, bool)
        if decisive(now, explained, limit, concerned):
            better.append((trial, explained))
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


def _inertias(log: Log, now: Explanation) -> float:
    """Sum over joints of the mean inertia divided by its standard deviation, over the square root of their number."""
    tau, (q, qd, qdd) = log.torques(), log.states()
    n, d = q.shape
    chosen = q[np.linspace(0, n - 1, INERTIAS).astype(int)]
    total, sizes = 0.0, sizes_of(qdd, tau)
    joints = ("revolute",) * d if log.data.needs is None else log.data.needs.joints
    for joint in range(d):
        push = np.zeros_like(chosen)
        push[:, joint] = 1.0
        pushed = (chosen, np.zeros_like(chosen), push)
        with_log = _kinetic(now, covariances(pushed, (q, qd, qdd), joints, sizes))
        alone = _kinetic(now, covariances(pushed, pushed, joints, sizes))
        mean_with = with_log.reshape(INERTIAS, d, -1)[:, joint].mean(axis=0)
        variance = alone.reshape(INERTIAS, d, INERTIAS, d)[:, joint, :, joint].mean()
        variance = max(float(variance - mean_with @ now.inverse @ mean_with), 1e-12 * float(variance))
        total += float(mean_with @ now.pull) / np.sqrt(variance)
    return total / np.sqrt(d)


def _kinetic(now: Explanation, parts: list[Parts]) -> np.ndarray:
    """Covariance of the torques of all kinetic energies, by their weights."""
    return np.add.reduce([weight * part.kinetic for weight, part in zip(now.weights[::2], parts, strict=False)])


def _friction(log: Log, build: Build, now: Explanation) -> tuple[np.ndarray, ...]:
    """Viscous and dry friction, the error of the latter, its velocity scale, and torques of friction and noise only."""
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
        numbers.append([own[0] / typical[joint], own @ dry, np.sqrt(max(dry @ spread @ dry, 0.0))])
    viscous, coulomb, error = np.array(numbers).T
    return viscous, coulomb, error, SCALES[0] * typical, rest
