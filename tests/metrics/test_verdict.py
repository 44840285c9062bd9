"""Sound fits are good, failed ones refused, and each verdict says why."""

import numpy as np
import pytest
from calls import one_line

from dln_jax.errors import FitRefused
from dln_jax.metrics.errors import LEVELS as PROBABILITIES
from dln_jax.metrics.errors import coverage, half_width
from dln_jax.metrics.verdict import LEVELS, HeldOut, Verdict, held_out, judge, verdict_metrics, worst

RANDOM = np.random.default_rng(3)
TRUTH = np.cumsum(RANDOM.normal(size=(4_000, 3)), axis=0) % [3.0, 7.0, 0.2] + [0.0, 40.0, 0.1]
SCALE = TRUTH.std(axis=0)
NOISE = 0.05 * SCALE
MEASURED = TRUTH + NOISE * RANDOM.normal(size=TRUTH.shape)
MEAN = 0 * TRUTH + TRUTH.mean(axis=0)


def verdict_of(predicted, measured=MEASURED, **known):
    return judge(held_out(predicted, measured, **known), ["hip", "knee", "toe"])


def with_joint(joint, values, base=TRUTH):
    changed = base.copy()
    changed[:, joint] = values
    return changed


def test_level_and_reason():
    for predicted, level, words in (
        (TRUTH, "good", "held-out nMSE 0.002"),
        (TRUTH + 0.05 * SCALE, "good", "worst"),
        (TRUTH + 0.12 * SCALE, "doubtful", "errors of hip, knee, toe are up to 6.69 times the noise"),
        (with_joint(1, TRUTH[:, 1] + 0.12 * SCALE[1]), "doubtful", "errors of knee are up to 6.69 times the noise"),
        (with_joint(1, TRUTH[:, 1] + 0.4 * SCALE[1]), "doubtful", "5% of the torque of knee is unexplained"),
        (with_joint(2, -TRUTH[:, 2]), "refused", "torque of toe is predicted no better than by a constant"),
        (0 * TRUTH, "refused", "knee"),
        (MEAN, "refused", "hip, knee, toe"),
        (with_joint(0, np.inf), "refused", "hip is not finite"),
        (with_joint(0, np.nan), "refused", "hip is not finite"),
    ):
        verdict = verdict_of(predicted, noise=NOISE)
        assert verdict.level == level and words in verdict.line
        assert bool(verdict.remedy) == (level != "good") and "\n" not in verdict.line


def noisy(noise):
    return TRUTH + noise * RANDOM.normal(size=TRUTH.shape)


def test_errors_are_judged_in_units_of_torque_and_noise():
    rough, tiny, loud = noisy(0.4 * SCALE), {"noise": 1e-6 * SCALE}, 3 * SCALE
    passive = with_joint(0, 0.0)
    for why, predicted, measured, known, level in (
        ("errors of the size of the noise", TRUTH, rough, {"noise": 0.4 * SCALE}, "good"),
        ("the same if the noise is unknown", TRUTH, rough, {}, "doubtful"),
        ("or infinite", TRUTH, rough, {"noise": np.full(3, np.inf)}, "doubtful"),
        ("far above the noise, but small", TRUTH + 0.05 * SCALE, TRUTH, tiny, "good"),
        ("far above the noise", TRUTH + 0.1 * SCALE, TRUTH, tiny, "doubtful"),
        ("passive joint", passive, passive, {}, "good"),
        ("passive joint, in units of all torques", with_joint(0, 60.0), passive, {}, "refused"),
        ("no torque", 0 * TRUTH, 0 * TRUTH, {}, "refused"),
        ("all below their noise", MEAN + 0.8 * (TRUTH - MEAN), noisy(loud), {"noise": loud}, "doubtful"),
        ("an exact file, and a fit to rounding", TRUTH + 1e-9, TRUTH, {"file": TRUTH}, "good"),
    ):
        assert verdict_of(predicted, measured, **known).level == level, why


def test_joint_whose_torque_is_noise_is_not_judged():
    noise = SCALE * [0.01, 0.01, 3.0]
    measured = noisy(noise)
    predicted = with_joint(2, TRUTH[:, 2].mean())
    verdict = verdict_of(predicted, measured, noise=noise)
    assert verdict.level == "good" and "torque of toe does not rise above its noise" in verdict.reason
    assert verdict_of(predicted, measured).level == "refused"


def test_fit_that_is_worse_than_the_robots_file():
    for error, level in ((0.08, "good"), (0.2, "doubtful"), (0.22, "refused")):
        verdict = verdict_of(TRUTH + error * SCALE, file=TRUTH + 0.15 * SCALE, noise=NOISE)
        assert verdict.level == level
        assert ("robot's file predicts held-out torques better" in verdict.reason) == (level != "good")


def test_worst_of_several_names_the_faults_of_the_log_if_it_is_not_good():
    good, bad = Verdict("good", "a"), Verdict("refused", "d", "mend d")
    one, two = (Verdict("doubtful", each, f"mend {each}") for each in "bc")
    assert worst(good, good) == worst(good, causes=["q is coarse"]) == good
    assert worst(good, one, two) == Verdict("doubtful", "b; c", "mend b; mend c")
    assert worst(one, bad, good) == bad
    assert worst(good, bad, causes=["q is coarse"]) == Verdict("refused", "d; in the log, q is coarse", "mend d")
    assert str(FitRefused(bad)) == "the fit is refused: d; mend d"


def test_metrics_are_numbers():
    errors = held_out(TRUTH, MEASURED, noise=NOISE, file=TRUTH)
    metrics = verdict_metrics(errors, judge(errors))
    assert metrics["verdict"] == LEVELS.index("good") == 0
    assert metrics["noise_nmse"] == pytest.approx(0.0025, rel=0.05) and metrics["zero_nmse"] > 1
    assert all(isinstance(value, int | float) for value in metrics.values())
    assert "file_nmse" not in verdict_metrics(HeldOut(*errors[:3]), judge(errors))
    alone = judge(held_out(TRUTH[:, :1], MEASURED[:, :1]))
    assert alone.level == "good" and "worst" not in alone.reason
    with one_line("no held-out samples"):
        held_out(TRUTH[:0], MEASURED[:0])


def test_a_calm_block_of_a_recording_is_judged_in_units_of_the_whole_recording():
    """In it the torque varies as little as an error that would be small in the rest."""
    random = np.random.default_rng(5)
    recording = np.concatenate([random.normal(size=(900, 1)), 0.05 * random.normal(size=(100, 1))])
    calm, predicted = recording[900:], recording[900:] + 0.05 * random.normal(size=(100, 1))
    assert judge(held_out(predicted, calm)).level == "refused"
    assert judge(held_out(predicted, calm, recording=recording)).level == "good"
    assert judge(held_out(predicted + 2.0, calm, recording=recording)).level == "refused"


def test_errors_that_are_too_fast_for_the_motion_are_a_doubt():
    """Noise of differentiated accelerations at 20 Hz beside torques at 0.5 Hz; a wrong sign is slow, and refused."""
    t = np.arange(0, 10, 0.005)
    torque = np.stack([np.sin(np.pi * t), np.cos(np.pi * t)], axis=1)
    fast = 0.9 * np.sin(40 * np.pi * t[:, None] + [0.0, 1.0])
    verdict = judge(held_out(torque + fast, torque))
    assert verdict.level == "doubtful" and "--cutoff" in verdict.remedy and "sign" not in verdict.line
    wrong = judge(held_out(torque * [1, -1] + fast, torque))
    assert wrong.level == "refused" and "sign" in wrong.remedy


def test_bands_of_a_normal_variable_hold_what_they_say():
    random = np.random.default_rng(0)
    std = random.uniform(0.5, 2.0, (20_000, 2))
    covered = coverage(std * random.normal(size=std.shape), std)
    np.testing.assert_allclose(covered, np.tile(PROBABILITIES, (2, 1)).T, atol=0.015)
    assert half_width(0.95) == pytest.approx(1.959964, abs=1e-6)
    for wrong, levels, words in (
        (std[:, :1], (0.5,), "expected the same"),
        *((std, (p,), "level") for p in (0, 1, np.nan)),
    ):
        with one_line(words):
            coverage(std, wrong, levels=levels)
