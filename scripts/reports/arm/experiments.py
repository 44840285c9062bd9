"""The experiments of the first DeLaN paper (Lutter, Ritter and Peters 2019, arXiv:1907.04490) on the exact arm.

Offline: torque errors on unseen letters, against the number of training letters and at other speeds than in training.
A letter at s times its speed is the motion (q, s qd, s² qdd), with the torque of the exact plant. All models are fitted
to the same samples with the same number of iterations, and selected by the same held-out samples.

Online: the arm learns its own dynamics while it writes, with feed-forward torques by the current model and feedback:

    tau_k = f(q*, qd*, qdd*; theta_i) + P (q* - q_k) + D (qd* - qd_k)      held for 1 ms, within +-25 and +-15 N m

The parameters theta_0 are random. After every letter they are fitted to all samples recorded so far. No letter is
written twice, so all errors are those of unseen motions.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.interpolate import CubicSpline

from dln_jax.control.closed_loop import Hardware, following, simulate
from dln_jax.control.observers import with_differences
from dln_jax.control.state_space import field_of
from dln_jax.control.tracking import Gains, Reference, feed_forward, feedback
from dln_jax.data.encoders.smoothing import smooth
from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.data.splits import every, label_indices, select
from dln_jax.learning.online import Refit, append_recording, empty_replay, learn_online, make_linear_refit, make_refit
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.errors import mean_square
from dln_jax.models.baselines import make_feed_forward
from dln_jax.models.model import Model, Parameters, make_black_box_lagrangian, make_delan
from dln_jax.models.trigonometric import make_planar_chain
from dln_jax.scenes.datasets.generators import CHARACTERS_TEST
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.types import InputError
from scripts.reports.arm.data import letters as letters_of
from scripts.reports.arm.data import partition_labels
from scripts.reports.arm.models import WIDTHS
from scripts.reports.run import Numbers

TYPICAL_RATE, TYPICAL_ACCELERATION, TYPICAL_TORQUE = 0.5, 2.0, 2.0
"""Typical magnitudes of a letter's motion in rad/s, rad/s² and N m; they scale the networks for all data."""
IDENTIFIED = "identified-arm"
COUNTS, SPEEDS = (1, 2, 3, 5, 8), (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0)
THINNED = 2
"""Every second sample is fitted, 12.5 per second; all samples of the test letters are evaluated."""
RATE, RECORDED = 1000.0, 25.0
"""Rates of the controller and, at normal speed, of the training samples, Hz."""
GAINS = Gains(np.array([60.0, 30.0]), np.array([12.0, 5.0]))
"""P in N m/rad and D in N m s/rad."""
LIMITS = np.array([25.0, 15.0])
"""Torque limits, N m."""
CUTOFF, LEARNED = 50.0, 10.0
"""Cut-off of the low-pass after differences of noisy readings, and of the filter of readings to learn from, Hz."""
LOST = 1.0
"""A letter counts as lost once the tracking error of a joint is larger, rad; its run is cut off there."""


class Learner(NamedTuple):
    """A model and its fit, compiled once."""

    model: Model
    refit: Refit
    start: Callable[[int], Parameters]
    """Seed -> initial parameters."""
    torques: Callable[..., Array]
    """(parameters, q, qd, qdd [N, d]) -> tau [N, d]."""


@functools.cache
def learners(*, rounds: int) -> dict[str, Learner]:
    """The models by name; networks are fitted by `rounds` of five Levenberg-Marquardt iterations.

    The identified arm is a planar chain of two links with unknown inertias, weights and joint friction: 12 parameters
    by linear least squares.
    """
    needs = two_link_arm().needs
    size = {name: {"width": width, "dtype": jnp.float64} for name, width in WIDTHS.items()}
    scales = {"rate_scale": TYPICAL_RATE, "acceleration_scale": TYPICAL_ACCELERATION, "tau_scale": TYPICAL_TORQUE}
    both_sides = make_feed_forward(needs, **scales, **size["feed-forward"])

    def inverse_side(key):
        return {name: layers for name, layers in both_sides.init(key).items() if name.startswith("inverse")}

    models = {
        "structured-delan": make_delan(needs, **size["structured-delan"]),
        "black-box-delan": make_black_box_lagrangian(needs, rate_scale=TYPICAL_RATE, **size["black-box-delan"]),
        "feed-forward": Model(inverse_side, both_sides.energies),
        IDENTIFIED: make_planar_chain(needs._replace(friction=True), symmetric=False),
    }

    def learner(name, model):
        @jax.jit
        def torques(parameters, *motion: Array):
            return jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics)(*motion)

        refit = make_linear_refit(model) if name == IDENTIFIED else make_refit(model, rounds=rounds)
        return Learner(model, refit, jax.jit(lambda seed: model.init(jax.random.key(seed))), torques)

    return {name: learner(name, model) for name, model in models.items()}


def measure_letters(
    by: str, *, data: Path | None = None, test: tuple[str, ...] = CHARACTERS_TEST, splits: int = 3, seeds: int = 2,
    rounds: int = 8,
) -> Numbers:  # fmt: skip
    """Test errors of all models by the number of "letters" or by "speeds": median and worst over splits and seeds.

    Args:
        test: the first set of test letters; other splits are disjoint groups of the same size.
        rounds: rounds of five Levenberg-Marquardt iterations.
    """
    written = letters_of(data)
    if not np.allclose(faster(written, 1.0).tau, written.tau, atol=1e-6):
        raise InputError(
            "tau is not that of the published two-link arm, whose torques at other speeds are to be predicted; "
            "give letters of that arm, or measure others with --only published,online"
        )
    present = len(np.unique(written.trajectory))
    most = present - len(test)
    if by == "speeds":
        settings = {f"speed-{speed:g}": (most, speed) for speed in SPEEDS}
    else:
        settings = {f"{count}-letters": (count, 1.0) for count in (*(count for count in COUNTS if count < most), most)}
    groups = partition_labels(written, max(2, present // len(test)))
    tests = [list(test), *(group[: len(test)] for group in groups if set(group) != set(test))][:splits]
    name, known = "embedded-letters" if data is None else data.stem, learners(rounds=rounds)
    errors, facts = dict[str, list[float]](), dict[str, list[tuple[float, float]]]()
    for labels in tests:
        held_out = select(written, label_indices(written, labels))
        for seed in range(seeds):
            fits = {}
            for setting, (count, speed) in settings.items():
                moved = faster(held_out, speed)
                if count not in fits:
                    fits[count] = {key: fitted(learner, written, labels, count, seed) for key, learner in known.items()}
                for model, (parameters, _) in fits[count].items():
                    torques = known[model].torques(parameters, moved.q, moved.qd, moved.qdd)
                    case = errors.setdefault(f"{model}/{name}/{setting}", [])
                    case.append(mean_square(np.asarray(torques) - moved.tau))
                now, seen = states(moved), fits[count][IDENTIFIED][1]
                outside = ((now < seen.min(axis=0)) | (now > seen.max(axis=0))).any(axis=1)
                case = facts.setdefault(f"data/{name}/{setting}", [])
                case.append((mean_square(moved.tau), outside.mean()))
    numbers = {
        case: {"torque_mse_median": np.median(values), "torque_mse_worst": max(values)}
        for case, values in errors.items()
    }
    for case, values in facts.items():
        torque, outside = np.median(values, axis=0)
        numbers[case] = {"torque_mean_square": torque, "share_outside_training": outside}
    return numbers


def fitted(
    learner: Learner, data: Trajectories, test: list[str], count: int, seed: int
) -> tuple[Parameters, np.ndarray]:
    """Fits a model to `count` letters without those of the test; returns its parameters and the states that it saw.

    Smaller sets of letters are subsets of larger ones.
    """
    present = np.setdiff1d(np.unique(data.trajectory), label_indices(data, test))
    chosen = np.random.default_rng([seed, 1]).permutation(present)[:count].tolist()
    thin = every(data, THINNED)
    replay = empty_replay(len(thin.t), data.degrees_of_freedom)
    for index in chosen:
        letter = select(thin, [index])
        replay = append_recording(replay, letter.q, letter.qd, letter.qdd, letter.tau)
    return learner.refit(learner.start(seed), replay), states(select(thin, chosen))


def states(data: Trajectories) -> np.ndarray:
    """The states (q, qd, qdd) of all samples, [N, 3 d]."""
    return np.hstack([data.q, data.qd, data.qdd])


def faster(data: Trajectories, speed: float) -> Trajectories:
    """The same paths at `speed` times their speed, with the torques of the exact plant."""
    q, qd, qdd = data.q, speed * data.qd, speed**2 * data.qdd
    tau = jax.jit(jax.vmap(dynamics(two_link_arm().closed_form).inverse_dynamics))(q, qd, qdd)
    return from_arrays({"t": data.t / speed, "trajectory": data.trajectory, "q": q, "qd": qd, "qdd": qdd, "tau": tau})


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
    written, exact = letters_of(data), dynamics(two_link_arm().closed_form)
    name = "embedded-letters" if data is None else data.stem
    orders = [drawn_letters(written, letters, seed, speed) for seed in range(seeds)]
    longest = max(samples for motions in orders for _, samples in motions)
    replay = empty_replay(letters * (1 + int(np.ceil(RECORDED * speed * longest / RATE))), 2)
    gained = Gains(gains * GAINS.proportional, gains**0.5 * GAINS.derivative)

    def learned(learner, parameters):
        return feed_forward(dynamics(learner.model.energies(parameters)), gained)

    fixed = lambda _: (), lambda parameters, _: parameters
    models = {
        "feedback-alone": (*fixed, lambda _: functools.partial(feedback, gained)),
        "exact-model": (*fixed, lambda _: feed_forward(exact, gained)),
        **{
            name: (one.start, one.refit, functools.partial(learned, one))
            for name, one in learners(rounds=rounds).items()
        },
    }
    numbers = {}
    for model, (start, refit, law) in models.items():
        write = writing(law, speed, encoder_noise)
        errors = np.array(
            [
                [outcome for outcome, *_ in learn_online(order, write, refit, start(seed), replay)]
                for seed, order in enumerate(orders)
            ]
        )
        rows = {"lost_letters": np.isinf(errors).sum(), "letters": letters * seeds}
        for place, which in {0: "first", 1: "second", letters - 1: "last"}.items():
            rows[f"{which}_tip_error_m_median"] = np.median(errors[:, place])
            rows[f"{which}_tip_error_m_worst"] = errors[:, place].max()
        numbers[f"{model}/{name}/{condition}"] = rows
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


Write = Callable[[Any, tuple[Reference, int]], tuple[float, tuple[Any, Any, Any, Any]]]
"""(parameters, letter) -> rms error of the tip in m, and the recording."""


def writing(law: Callable[[Any], Any], speed: float, encoder_noise: float) -> Write:
    """The exact arm under the law of some parameters, as one compiled program for all parameters."""
    noisy = encoder_noise > 0
    hardware = Hardware(-LIMITS, LIMITS, encoder_noise=encoder_noise, sees_rates=not noisy)
    arm = two_link_arm()
    assert arm.tip is not None
    field, tip, step = field_of(dynamics(arm.closed_form)), jax.vmap(arm.tip), round(RATE / (RECORDED * speed))

    @jax.jit
    def run(parameters, wanted, key):
        controller = following(law(parameters), wanted, rate=RATE)
        if noisy:
            controller = with_differences(controller, 2, rate=RATE, cutoff=CUTOFF)
        start, seconds = jnp.concatenate([wanted.q[0], wanted.qd[0]]), len(wanted.q) / RATE
        done = simulate(field, controller, start, seconds=seconds, rate=RATE, controls=2, hardware=hardware, key=key)
        x = done.x[:-1]
        return done, jax.vmap(field)(x, done.u)[:, 2:], tip(x[:, :2]) - tip(wanted.q)

    def write(parameters, letter) -> tuple[float, Any]:
        wanted, samples = letter
        done, qdd, off_tip = jax.tree.map(np.asarray, run(parameters, wanted, jax.random.key(samples)))
        lost = np.flatnonzero(~(np.abs(done.x[:samples, :2] - wanted.q[:samples]).max(axis=1) <= LOST))
        end = int(lost[0]) if len(lost) else samples
        q, qd = np.hsplit(done.x[:end], 2)
        recording = tuple(array[:end:step] for array in (q, qd, qdd, done.u))
        if noisy and end < RATE / 2:
            recording = (np.zeros((0, 2)),) * 4
        elif noisy:
            log = {"t": done.t[:end], "q": done.y[:end], "tau": done.u[:end], "trajectory": np.zeros(end, int)}
            filtered = smooth(from_arrays(log), LEARNED, decimate=step).data
            recording = filtered.q, filtered.qd, filtered.qdd, filtered.tau
        return np.inf if len(lost) else np.sqrt(np.mean(np.sum(off_tip[:end] ** 2, axis=1))), recording

    return write
