"""An arm learns its own dynamics while it writes: feed-forward torques by the current model, plus PD feedback.

The online experiment of Lutter, Ritter and Peters (2019, arXiv:1907.04490), on the exact two-link arm:

    tau_k = f(q*, qd*, qdd*; theta_i) + P (q* - q_k) + D (qd* - qd_k)      held for 1 ms, within +-25 and +-15 N m

The parameters theta_0 are random. After every letter they are fitted to all samples recorded so far. No letter is
written twice, so all errors are those of unseen motions.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

from dln_jax.control import Gains, Hardware, Reference, feed_forward, field_of, following, simulate, with_differences
from dln_jax.control.tracking import feedback
from dln_jax.data.encoders import smooth
from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.data.splits import select
from dln_jax.learning.online import empty_replay, learn_online
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import two_link_arm
from scripts.reports.arm.data import letters as letters_of
from scripts.reports.arm.learners import Learner, learners
from scripts.reports.run import Numbers

RATE, RECORDED = 1000.0, 25.0
"""Rates of the controller and, at normal speed, of the training samples, Hz."""
GAINS = Gains(np.array([60.0, 30.0]), np.array([12.0, 5.0]))
"""P in N m/rad and D in N m s/rad."""
LIMITS = np.array([25.0, 15.0])
"""Torque limits, N m."""
CUTOFF = 50.0
"""Cut-off of the low-pass after differences of noisy readings, Hz."""
LOST = 1.0
"""A letter counts as lost once the tracking error of a joint is larger, rad; its run is cut off there."""
MODELS = ("feedback-alone", "exact-model", "structured-delan", "black-box-delan", "feed-forward", "identified-arm")


def measure_online(
    condition: str, *, speed: float = 1.0, gains: float = 1.0, encoder_noise: float = 0.0,
    data: Path | None = None, letters: int = 8, seeds: int = 3, rounds: int = 4,
) -> Numbers:  # fmt: skip
    """Tracking errors of the first, second and last letter: median and worst over seeds; infinite for a lost letter.

    Args:
        speed: factor on the speed of the letters.
        gains: factor on P; D is multiplied by its square root.
        encoder_noise: standard deviation of the encoders, rad; if positive, rates are low-passed differences.
        seeds: seeds of initial parameters and of the order of letters.
        rounds: rounds of five Levenberg-Marquardt iterations after every letter.
    """
    written, known = letters_of(data), learners(rounds=rounds)
    name = "embedded-letters" if data is None else data.stem
    orders = [drawn_letters(written, letters, seed, speed) for seed in range(seeds)]
    longest = max(samples for motions in orders for _, samples in motions)
    places = letters * (1 + int(np.ceil(RECORDED * speed * longest / RATE)))
    numbers = {}
    for model in MODELS:
        write = writing(known.get(model), model, speed=speed, gains=gains, encoder_noise=encoder_noise)
        runs = [written_by(write, known.get(model), orders[seed], seed, places) for seed in range(seeds)]
        rows: dict[str, float] = {}
        for place, which in {0: "first", 1: "second", letters - 1: "last"}.items():
            for column, quantity in enumerate(("joint_error_rad", "tip_error_m")):
                values = [run[place][column] for run in runs]
                rows[f"{which}_{quantity}_median"] = float(np.median(values))
                rows[f"{which}_{quantity}_worst"] = max(values)
        every = np.array([letter for run in runs for letter in run])
        rows |= {"lost_letters": int(np.isinf(every[:, 0]).sum()), "letters": len(every)}
        numbers[f"{model}/{name}/{condition}"] = rows | {"share_saturated": float(every[:, 2].mean())}
    return numbers


def drawn_letters(data: Trajectories, count: int, seed: int, speed: float) -> list[tuple[Reference, int]]:
    """Distinct letters in an order set by the seed, at the controller's rate, and their numbers of samples.

    A cubic spline passes through the angles. Rest after its end makes all letters equally long.
    """
    references = {}
    for index in np.unique(data.trajectory).tolist():
        letter = select(data, [index])
        seconds = letter.t - letter.t[0]
        spline = CubicSpline(seconds, letter.q)
        t = speed * np.arange(int(seconds[-1] / speed * RATE) + 1) / RATE
        references[index] = (spline(t), speed * spline(t, 1), speed**2 * spline(t, 2))
    longest = max(len(q) for q, _, _ in references.values())
    motions = []
    for index in np.random.default_rng([seed, 2]).permutation(list(references))[:count].tolist():
        q, qd, qdd = references[index]
        more = ((0, longest - len(q)), (0, 0))
        motions.append((Reference(np.pad(q, more, mode="edge"), np.pad(qd, more), np.pad(qdd, more)), len(q)))
    return motions


Write = Callable[[Any, tuple[Reference, int]], tuple[tuple[float, float, float], tuple[Any, Any, Any, Any]]]
"""(parameters, letter) -> errors of joints in rad and tip in m, share of saturated samples; and the recording."""


def writing(learner: Learner | None, model: str, *, speed: float, gains: float, encoder_noise: float) -> Write:
    """The exact arm under feedback and the torques of a model, as one compiled program for all parameters."""
    weaker = Gains(gains * GAINS.proportional, gains**0.5 * GAINS.derivative)
    noisy = encoder_noise > 0
    hardware = Hardware(-LIMITS, LIMITS, encoder_noise=encoder_noise, sees_rates=not noisy)
    arm = two_link_arm()
    assert arm.tip is not None
    exact, tip = dynamics(arm.closed_form), jax.vmap(arm.tip)
    field, step = field_of(exact), round(RATE / (RECORDED * speed))

    @jax.jit
    def run(parameters: Any, wanted: Reference, key: jax.Array) -> tuple[Any, ...]:
        if model == "feedback-alone":
            law = partial(feedback, weaker)
        else:
            own = exact if learner is None else dynamics(learner.model.energies(parameters))
            law = feed_forward(own, weaker)
        controller = following(law, wanted, rate=RATE)
        if noisy:
            controller = with_differences(controller, 2, rate=RATE, cutoff=CUTOFF)
        start, seconds = jnp.concatenate([wanted.q[0], wanted.qd[0]]), len(wanted.q) / RATE
        done = simulate(field, controller, start, seconds=seconds, rate=RATE, controls=2, hardware=hardware, key=key)
        x = done.x[:-1]
        return done, jax.vmap(field)(x, done.u)[:, 2:], tip(x[:, :2]) - tip(wanted.q)

    def write(parameters: Any, letter: tuple[Reference, int]) -> tuple[Any, Any]:
        wanted, samples = letter
        done, qdd, off_tip = jax.tree.map(np.asarray, run(parameters, wanted, jax.random.key(samples)))
        off = done.x[:-1, :2] - wanted.q
        lost = np.flatnonzero(~(np.abs(off[:samples]).max(axis=1) <= LOST))
        end = int(lost[0]) if len(lost) else samples
        q, qd = np.hsplit(done.x[:end], 2)
        recording = tuple(array[:end:step] for array in (q, qd, qdd, done.u))
        if noisy and end < RATE / 2:
            recording = (np.zeros((0, 2)),) * 4
        elif noisy:
            log = {"t": done.t[:end], "q": done.y[:end], "tau": done.u[:end], "trajectory": np.zeros(end, int)}
            filtered = smooth(from_arrays(log), decimate=step).data
            recording = filtered.q, filtered.qd, filtered.qdd, filtered.tau
        joint, tips = (
            np.inf if len(lost) else float(np.sqrt(np.mean(np.sum(deviation[:end] ** 2, axis=1))))
            for deviation in (off, off_tip)
        )
        saturated = float(np.mean((np.abs(done.u[: max(end, 1)]) >= LIMITS).any(axis=1)))
        return (joint, tips, saturated), recording

    return write


def written_by(
    write: Write, learner: Learner | None, letters: list[tuple[Reference, int]], seed: int, places: int
) -> list[tuple[float, float, float]]:
    """Writes letters one after the other and refits the model, if any, after every letter."""
    start, refit = ((), lambda parameters, _: parameters) if learner is None else (learner.start(seed), learner.refit)
    return [visit.outcome for visit in learn_online(letters, write, refit, start, empty_replay(places, 2))]
