"""An arm learns its own dynamics while it writes: feed-forward torques by the current model, plus PD feedback.

The online experiment of Lutter, Ritter and Peters (2019, arXiv:1907.04490), on the exact two-link arm:

    tau_k = f(q*, qd*, qdd*; theta_i) + P (q* - q_k) + D (qd* - qd_k)      held for 1 ms, within +-25 and +-15 N m

The parameters theta_0 are random. After every letter they are fitted to all samples recorded so far. No letter is
written twice, so all errors are those of unseen motions.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import (
    ClosedLoopRun,
    Gains,
    Hardware,
    Reference,
    Tracker,
    feed_forward,
    field_of,
    following,
    simulate,
    with_differences,
)
from dln_jax.control.tracking import feedback
from dln_jax.data.encoders import smooth
from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.learning.online import empty_replay, learn_online
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.scenes.pendulums import two_link_arm
from scripts.reports.arm.motions import RATE, RECORDED, Motion, capacity, drawn_letters
from scripts.reports.arm.rivals import Rival, rivals
from scripts.reports.case import Case, Findings, spread
from scripts.reports.rows import Row

GAINS = Gains(np.array([60.0, 30.0]), np.array([12.0, 5.0]))
"""P in N m/rad and D in N m s/rad."""
LIMITS = np.array([25.0, 15.0])
"""Torque limits, N m."""
CUTOFF = 50.0
"""Cut-off of the low-pass after differences of noisy readings, Hz."""
LOST = 1.0
"""A letter counts as lost once the tracking error of a joint is larger, rad; its run is cut off there."""


class Condition(NamedTuple):
    """Conditions under which the arm writes."""

    speed: float = 1.0
    gains: float = 1.0
    """Factor on P; D is multiplied by its square root."""
    encoder_noise: float = 0.0
    """Standard deviation of the encoders, rad; if positive, rates are low-passed differences of readings."""


CONDITIONS = {
    "nominal": Condition(),
    "low-gains": Condition(gains=0.1),
    "double-speed": Condition(speed=2.0),
    "noisy-encoders": Condition(encoder_noise=3e-4),
}


class Effort(NamedTuple):
    """Numbers of letters, seeds and iterations, and the conditions."""

    letters: int = 8
    seeds: int = 3
    """Number of seeds for initial parameters and the order of letters."""
    rounds: int = 4
    """Number of rounds of five Levenberg-Marquardt iterations after every letter."""
    conditions: tuple[str, ...] = tuple(CONDITIONS)


QUICK = Effort(letters=2, seeds=1, rounds=1, conditions=("nominal",))


class Written(NamedTuple):
    """Result of writing one letter."""

    joint_error: float
    """Root mean square over samples of the norm over joints, rad; infinite for a lost letter."""
    tip_error: float
    """Root mean square error of the tip, m; infinite for a lost letter."""
    saturated: float
    """Share of samples at a torque limit."""


def cases(name: str, data: Trajectories, *, quick: bool = False) -> list[Case]:
    """One case per condition."""
    effort = QUICK if quick else Effort()
    return [
        Case(f"{name}/online-{condition}", partial(measure, name, data, condition, effort))
        for condition in effort.conditions
    ]


Law = Callable[[Parameters, Gains], Tracker]


def laws(learners: Mapping[str, Rival]) -> dict[str, Law]:
    """Control laws by name, as functions of parameters and gains; laws that do not learn ignore the parameters."""
    exact = dynamics(two_link_arm().closed_form)
    return {
        "feedback-alone": lambda _, gains: partial(feedback, gains),
        "exact-model": lambda _, gains: feed_forward(exact, gains),
        **{name: partial(_by_model, rival.model) for name, rival in learners.items()},
    }


def _by_model(model: Model, parameters: Parameters, gains: Gains) -> Tracker:
    return feed_forward(dynamics(model.energies(parameters)), gains)


def measure(name: str, data: Trajectories, condition: str, effort: Effort) -> Findings:
    """Tracking errors by letter: median and worst over seeds; the error of a lost letter is infinite."""
    learners, under = rivals(rounds=effort.rounds), CONDITIONS[condition]
    written: dict[str, list[list[Written]]] = {}
    motions = [drawn_letters(data, effort.letters, seed, under.speed) for seed in range(effort.seeds)]
    places = capacity(data, effort.letters)
    for model, law in laws(learners).items():
        drive = partial(write, closed_loop(law, under), under)
        learner, seeds = learners.get(model), range(effort.seeds)
        written[model] = [written_by(drive, learner, motions[seed], seed, places) for seed in seeds]
    rows = [row for model, runs in written.items() for row in rows_of(f"{model}/{name}/{condition}", runs)]
    return Findings(rows)


def written_by(
    drive: Callable, learner: Rival | None, motions: Sequence[Motion], seed: int, places: int
) -> list[Written]:
    """Writes the letters one after the other and refits the learner, if any, after every letter."""
    start, refit = ((), lambda parameters, _: parameters) if learner is None else (learner.start(seed), learner.refit)
    replay = empty_replay(places, 2)
    return [visit.outcome for visit in learn_online(motions, drive, refit, start, replay)]


def rows_of(case: str, runs: Sequence[Sequence[Written]]) -> list[Row]:
    """Errors of the first, second and last letter, the number of lost letters, and the share of saturated samples."""
    rows = []
    for place, name in {0: "first", 1: "second", len(runs[0]) - 1: "last"}.items():
        for quantity, unit in {"joint_error": "rad", "tip_error": "m"}.items():
            rows += spread(case, f"{name}_{quantity}", [getattr(run[place], quantity) for run in runs], unit)
    every = [letter for run in runs for letter in run]
    rows.append(Row(case, "lost_letters", float(sum(np.isinf(letter.joint_error) for letter in every))))
    rows.append(Row(case, "letters", float(len(every))))
    rows.append(Row(case, "share_saturated", float(np.mean([letter.saturated for letter in every]))))
    return rows


class Driven(NamedTuple):
    """A run of N samples along a reference."""

    run: ClosedLoopRun
    qdd: Any
    """Accelerations at the start of the samples [N, 2], rad/s²."""
    tip: Any
    """Tip of the arm, and below that of the reference [N, 2], m."""
    wanted_tip: Any


Loop = Callable[[Parameters, Reference, Array], Driven]
"""(parameters, reference, random key of the noise) -> the run along the reference."""


def closed_loop(law: Law, condition: Condition) -> Loop:
    """The exact arm under a control law, as one compiled program for all parameters and letters."""
    gains = Gains(condition.gains * GAINS.proportional, condition.gains**0.5 * GAINS.derivative)
    noisy = condition.encoder_noise > 0
    hardware = Hardware(-LIMITS, LIMITS, encoder_noise=condition.encoder_noise, sees_rates=not noisy)
    arm = two_link_arm()
    assert arm.tip is not None
    field, tip = field_of(dynamics(arm.closed_form)), jax.vmap(arm.tip)

    @jax.jit
    def run(parameters: Parameters, wanted: Reference, key: Array) -> Driven:
        controller = following(law(parameters, gains), wanted, rate=RATE)
        if noisy:
            controller = with_differences(controller, 2, rate=RATE, cutoff=CUTOFF)
        start = jnp.concatenate([wanted.q[0], wanted.qd[0]])
        seconds, about = len(wanted.q) / RATE, {"rate": RATE, "controls": 2, "hardware": hardware, "key": key}
        done = simulate(field, controller, start, seconds=seconds, **about)
        x = done.x[:-1]
        return Driven(done, jax.vmap(field)(x, done.u)[:, 2:], tip(x[:, :2]), tip(wanted.q))

    return run


def write(loop: Loop, condition: Condition, parameters: Parameters, motion: Motion) -> tuple[Written, tuple]:
    """Writes one letter; returns the result and the recording: exact states, or filtered encoder readings."""
    driven = jax.tree.map(np.asarray, loop(parameters, motion.reference, jax.random.key(motion.samples)))
    run, off = driven.run, driven.run.x[:-1, :2] - motion.reference.q
    lost = np.flatnonzero(~(np.abs(off[: motion.samples]).max(axis=1) <= LOST))
    end = int(lost[0]) if len(lost) else motion.samples
    step = round(RATE / (RECORDED * condition.speed))
    q, qd = np.hsplit(run.x[:end], 2)
    recording = tuple(array[:end:step] for array in (q, qd, driven.qdd, run.u))
    if condition.encoder_noise > 0:
        recording = _filtered(run.t[:end], run.y[:end], run.u[:end], step)
    joint_error, tip_error = (
        np.inf if len(lost) else float(np.sqrt(np.mean(np.sum(deviation[:end] ** 2, axis=1))))
        for deviation in (off, driven.tip - driven.wanted_tip)
    )
    saturated = float(np.mean((np.abs(run.u[: max(end, 1)]) >= LIMITS).any(axis=1)))
    return Written(joint_error, tip_error, saturated), recording


def _filtered(t: np.ndarray, q: np.ndarray, tau: np.ndarray, step: int) -> tuple[np.ndarray, ...]:
    """Filters encoder readings with `data.encoders.smooth`; returns no samples for less than half a second."""
    if len(t) < RATE / 2:
        return (np.zeros((0, 2)),) * 4
    log = from_arrays({"t": t, "q": q, "tau": tau, "trajectory": np.zeros(len(t), int)})
    data = smooth(log, decimate=step).data
    return data.q, data.qd, data.qdd, data.tau
