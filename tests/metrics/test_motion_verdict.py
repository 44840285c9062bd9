"""Verdicts of predicted motions: an explosion is never averaged away, neither chaos nor noise is a failure, and a model
has to do better than rest and straight lines after the samples that its start saw."""

import numpy as np
import pytest

from dln_jax.metrics.phase_space import Motions
from dln_jax.metrics.verdict import judge_motions, quarter_period

T = np.linspace(0, 10, 200)
PHASES = np.linspace(0, 6, 8)[:, None]
BOUNDED = np.array([True, True])


def swings(t, pace=1.0):
    return Motions(t, np.cos(pace * t + PHASES)[..., None], -np.sin(t + PHASES)[..., None])


TRUE = swings(T)
NO_MOMENTA = {"measured": np.array([True, False])}


def judged(predicted, true=TRUE, *, size=(2**-0.5, 2**-0.5), bounded=BOUNDED, **known):
    return judge_motions([predicted], [true], size=np.array(size), bounded=np.array(bounded), **known)


def scaled(q, p):
    return TRUE._replace(q=q * TRUE.q, p=p * TRUE.p)


def spoiled(place, value):
    """The true motions, but one has another q from a sample on."""
    q = TRUE.q.copy()
    q[3, place:] = value
    return TRUE._replace(q=q)


def test_level():
    angle = {"bounded": [False, True]}
    unknown = {**NO_MOMENTA, "noise": np.array([0.0, 30.0])}
    shifted = TRUE._replace(q=TRUE.q + 0.3, p=TRUE.p + 0.3)
    for why, predicted, known, level in (
        ("the truth", TRUE, {}, "good"),
        ("motions that part late", spoiled(100, 0.5), {}, "good"),
        ("standing still", scaled(0, 0), {}, "refused"),
        ("an angle that turns over", spoiled(150, 1e3), angle, "good"),
        ("but not to infinity", spoiled(150, np.inf), angle, "refused"),
        ("shifted", shifted, {}, "doubtful"),
        ("shifted by the noise of the start", shifted, {"noise": np.full(2, 0.3)}, "good"),
        ("momenta that were not measured", scaled(1, 3), NO_MOMENTA, "good"),
        ("nor does their noise count", scaled(0, 1), unknown, "refused"),
        ("half as fast", swings(T, 0.5), unknown, "refused"),
        ("rates that are explained", TRUE, {"rates": (0.0, 0.01)}, "good"),
        ("rates that are nearly explained", TRUE, {"rates": (0.0, 0.1)}, "doubtful"),
        ("rates that are not explained", TRUE, {"rates": (0.43, 0.4)}, "refused"),
    ):
        assert judged(predicted, **known).level == level, why


def test_one_motion_that_explodes_late_is_refused():
    for value in (np.inf, np.nan, 1e3):
        verdict = judged(spoiled(150, value))
        assert verdict.level == "refused" and "1 of 8 predicted test motions" in verdict.reason


def test_straight_lines_are_no_model_at_any_rate():
    for step in (0.2, 0.01):
        t = np.arange(0, 10, step)
        true = swings(t)
        q = true.q[:, 29:30] + true.p[:, 29:30] * (t - t[29])[:, None]
        lines = Motions(t, q, np.broadcast_to(true.p[:, 29:30], q.shape))
        for fitted in (1, 30):
            levels = [judged(each, true, bounded=[False, True], fitted=fitted).level for each in (lines, true)]
            assert levels == ["refused", "good"]


def test_samples_that_the_start_saw_do_not_count():
    seen = np.arange(len(T))[:, None] < 160
    assert judged(scaled(seen, seen), fitted=160).level == "refused"


def test_a_short_way_is_judged_in_units_of_the_straight_line():
    """Bodies start far apart and their forces bend their ways by 1e-4 of the spread of the data."""
    starts, t = np.linspace(-1, 1, 6)[:, None], np.linspace(0, 1, 40)
    bent, straight = (
        Motions(t, (starts + 0.1 * t + bend * t**2 / 2)[..., None], 0 * starts[..., None] + (0.1 + bend * t)[:, None])
        for bend in (0.02, 0.0)
    )
    assert np.mean(((bent.q - straight.q) / 0.7) ** 2) < 1e-4
    levels = [judged(each, bent, size=[0.7, 0.1]).level for each in (bent, straight)]
    assert levels == ["good", "refused"]


def test_another_random_walk_is_no_prediction():
    walks = np.cumsum(np.random.default_rng(0).normal(size=(2, 9, 300, 1)), axis=2)
    truth, predicted = (Motions(np.arange(300.0), walk - walk[:, :1], 0 * walk) for walk in walks)
    assert judged(predicted, truth, size=[walks.std(), 1.0], **NO_MOMENTA).level == "refused"


def test_time_is_that_of_the_system():
    """A quarter of a period at any rate, for oscillating positions and for angles that turn over."""
    for step in (0.1, 0.01):
        t = np.arange(0, 60, step)
        for states, bounded in ((np.cos(t), True), (t, False)):
            noisy = states[None, :, None] + 0.1 * np.random.default_rng(0).normal(size=(1, len(t), 1))
            assert quarter_period(noisy, np.array([bounded])) * step == pytest.approx(np.pi / 2, abs=step + 0.05)
