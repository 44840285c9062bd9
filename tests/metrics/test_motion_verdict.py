"""Verdicts of predicted motions: an explosion is never averaged away, neither chaos nor noise is a failure, and a model
has to do better than rest and straight lines after the samples that its start saw."""

import numpy as np
import pytest

from dln_jax.metrics.phase_space import Motions, quarter_period
from dln_jax.metrics.verdict import judge_motions

T = np.linspace(0, 10, 200)
PHASES = np.linspace(0, 6, 8)[:, None]
TRUE = Motions(T, np.cos(T + PHASES)[..., None], -np.sin(T + PHASES)[..., None])
SIZE = np.full(2, 2**-0.5)


def level(predicted, *, angle=False, **known):
    bounded = np.array([not angle, True])
    return judge_motions([predicted], [TRUE], size=SIZE, bounded=bounded, **known).level


def spoiled(place, value):
    """The true motions, but one has another q from a sample on."""
    q = TRUE.q.copy()
    q[3, place:] = value
    return TRUE._replace(q=q)


def test_the_truth_is_good():
    assert level(TRUE) == "good"


@pytest.mark.parametrize("value", [np.inf, np.nan, 1e3], ids=str)
def test_one_motion_that_explodes_late_is_refused(value):
    verdict = judge_motions([spoiled(150, value)], [TRUE], size=SIZE, bounded=np.array([True, True]))
    assert verdict.level == "refused" and "1 of 8 predicted test motions" in verdict.reason


def test_an_angle_may_turn_over_and_over_but_not_to_infinity():
    assert level(spoiled(150, 1e3), angle=True) == "good"
    assert level(spoiled(150, np.inf), angle=True) == "refused"


def test_motions_that_part_late_are_good_and_standing_still_is_refused():
    assert level(spoiled(100, 0.5)) == "good"
    assert level(TRUE._replace(q=0 * TRUE.q, p=0 * TRUE.p)) == "refused"


def test_noise_of_starts_is_no_error_of_the_model():
    shifted = TRUE._replace(q=TRUE.q + 0.3, p=TRUE.p + 0.3)
    assert level(shifted) == "doubtful"
    assert level(shifted, noise=np.full(2, 0.3)) == "good"


@pytest.mark.parametrize("step", [0.2, 0.05, 0.01, 0.001])
def test_straight_lines_are_no_model_at_any_rate(step):
    t = np.arange(0, 10, step)
    true = Motions(t, np.cos(t + PHASES)[..., None], -np.sin(t + PHASES)[..., None])
    q = true.q[:, 29:30] + true.p[:, 29:30] * (t - t[29])[:, None]
    lines = Motions(t, q, np.broadcast_to(true.p[:, 29:30], q.shape))
    bounded = np.array([False, True])
    for fitted in (1, 30):
        assert judge_motions([lines], [true], size=SIZE, bounded=bounded, fitted=fitted).level == "refused"
        assert judge_motions([true], [true], size=SIZE, bounded=bounded, fitted=fitted).level == "good"


def test_samples_that_the_start_saw_do_not_count():
    seen = np.arange(len(T))[:, None] < 30
    stopped = Motions(T, np.where(seen, TRUE.q, 0.0), np.where(seen, TRUE.p, 0.0))
    assert level(stopped, fitted=30) == "refused"


def test_unmeasured_momenta_count_neither_as_errors_nor_as_noise():
    measured, unknown = np.array([True, False]), np.array([0.0, 30.0])
    assert level(TRUE._replace(p=3 * TRUE.p), measured=measured) == "good"
    half = Motions(T, np.cos(T / 2 + PHASES)[..., None], TRUE.p)
    for wrong in (TRUE._replace(q=0 * TRUE.q), half):
        assert level(wrong, measured=measured, noise=unknown) == "refused"


def test_a_short_way_is_judged_in_units_of_the_straight_line():
    """Bodies start far apart and their forces bend their ways by 1e-4 of the spread of the data."""
    starts = np.linspace(-1, 1, 6)[:, None]
    t = np.linspace(0, 1, 40)
    bent, straight = (
        Motions(t, (starts + 0.1 * t + bend * t**2 / 2)[..., None], 0 * starts[..., None] + (0.1 + bend * t)[:, None])
        for bend in (0.02, 0.0)
    )
    known = {"size": np.array([0.7, 0.1]), "bounded": np.array([True, True])}
    assert np.mean(((bent.q - straight.q) / 0.7) ** 2) < 1e-4
    assert judge_motions([bent], [bent], **known).level == "good"
    assert judge_motions([straight], [bent], **known).level == "refused"


def test_another_random_walk_is_no_prediction():
    walks = np.cumsum(np.random.default_rng(0).normal(size=(2, 9, 300, 1)), axis=2)
    truth, predicted = (Motions(np.arange(300.0), walk - walk[:, :1], 0 * walk) for walk in walks)
    known = {"size": np.array([walks.std(), 1.0]), "bounded": np.ones(2, bool), "measured": np.array([True, False])}
    assert judge_motions([predicted], [truth], **known).level == "refused"


@pytest.mark.parametrize(
    ("shares", "expected"), [((0.0, 0.01), "good"), ((0.0, 0.1), "doubtful"), ((0.43, 0.4), "refused")]
)
def test_measured_rates_have_to_be_explained(shares, expected):
    assert level(TRUE, rates=np.array(shares)) == expected


def test_time_is_that_of_the_system():
    """A quarter of a period at any rate, for oscillating positions and for angles that turn over."""
    for step in (0.1, 0.01):
        t = np.arange(0, 60, step)
        for states, bounded in ((np.cos(t), True), (t, False)):
            noisy = states[None, :, None] + 0.1 * np.random.default_rng(0).normal(size=(1, len(t), 1))
            assert quarter_period(noisy, np.array([bounded])) * step == pytest.approx(np.pi / 2, abs=step + 0.05)
