"""Sound fits are good, failed ones refused, and each verdict says why."""

import numpy as np
import pytest

from dln_jax.errors import FitRefused
from dln_jax.metrics.verdict import LEVELS, HeldOut, Verdict, held_out, judge, verdict_metrics, worst
from dln_jax.types import InputError

RANDOM = np.random.default_rng(3)
TRUTH = np.cumsum(RANDOM.normal(size=(4_000, 3)), axis=0) % [3.0, 7.0, 0.2] + [0.0, 40.0, 0.1]
SCALE = TRUTH.std(axis=0)
NOISE = 0.05 * SCALE
MEASURED = TRUTH + NOISE * RANDOM.normal(size=TRUTH.shape)


def verdict_of(predicted, measured=MEASURED, **known):
    return judge(held_out(predicted, measured, **known), ["hip", "knee", "toe"])


def with_joint(joint, values, base=TRUTH):
    changed = base.copy()
    changed[:, joint] = values
    return changed


@pytest.mark.parametrize(
    ("predicted", "level", "words"),
    [
        (TRUTH, "good", "held-out nMSE 0.002"),
        (TRUTH + 0.05 * SCALE, "good", "worst"),
        (TRUTH + 0.12 * SCALE, "doubtful", "errors of hip, knee, toe are up to 6.7 times the noise"),
        (with_joint(1, TRUTH[:, 1] + 0.12 * SCALE[1]), "doubtful", "errors of knee are up to 6.7 times the noise"),
        (TRUTH + 0.4 * SCALE, "doubtful", "hip, knee, toe is unexplained"),
        (with_joint(1, TRUTH[:, 1] + 0.4 * SCALE[1]), "doubtful", "5% of the torque of knee is unexplained"),
        (with_joint(2, -TRUTH[:, 2]), "refused", "torque of toe is predicted no better than by a constant"),
        (0 * TRUTH, "refused", "knee"),
        (0 * TRUTH + TRUTH.mean(axis=0), "refused", "hip, knee, toe"),
        (1e3 * TRUTH, "refused", "no better than by a constant"),
        (with_joint(0, np.inf), "refused", "hip is not finite"),
        (with_joint(0, np.nan), "refused", "hip is not finite"),
    ],
)
def test_level_and_reason(predicted, level, words):
    verdict = verdict_of(predicted, noise=NOISE)
    assert verdict.level == level and words in verdict.line
    assert bool(verdict.remedy) == (level != "good")
    assert "\n" not in verdict.line


def test_errors_of_the_size_of_the_noise_are_not_doubtful():
    noise = 0.4 * SCALE
    measured = TRUTH + noise * RANDOM.normal(size=TRUTH.shape)
    assert verdict_of(TRUTH, measured, noise=noise).level == "good"
    assert verdict_of(TRUTH, measured).level == "doubtful"
    assert verdict_of(TRUTH, measured, noise=np.full(3, np.inf)).level == "doubtful"


def test_errors_far_above_a_tiny_noise_that_do_not_matter_are_good():
    tiny = 1e-6 * SCALE
    assert verdict_of(TRUTH + 0.05 * SCALE, TRUTH, noise=tiny).level == "good"
    assert verdict_of(TRUTH + 0.1 * SCALE, TRUTH, noise=tiny).level == "doubtful"


def test_faults_of_the_log_are_named_by_a_verdict_that_is_not_good():
    good, bad = Verdict("good", "a"), Verdict("refused", "b", "mend b")
    assert worst(good, causes=["q is coarse"]) == good and worst(bad, causes=[]) == bad
    assert worst(good, bad, causes=["q is coarse"]) == Verdict("refused", "b; in the log, q is coarse", "mend b")


def test_joint_whose_torque_is_noise_is_not_judged():
    noise = SCALE * [0.01, 0.01, 3.0]
    measured = TRUTH + noise * RANDOM.normal(size=TRUTH.shape)
    predicted = with_joint(2, TRUTH[:, 2].mean())
    verdict = verdict_of(predicted, measured, noise=noise)
    assert verdict.level == "good" and "torque of toe does not rise above its noise" in verdict.reason
    assert verdict_of(predicted, measured).level == "refused"
    everything = TRUTH.mean(axis=0) + 0.8 * (TRUTH - TRUTH.mean(axis=0))
    hidden = TRUTH + 3 * SCALE * RANDOM.normal(size=TRUTH.shape)
    assert verdict_of(everything, hidden, noise=3 * SCALE).level != "good"


def test_passive_joint_is_judged_in_units_of_all_torques():
    measured = with_joint(0, 0.0)
    assert verdict_of(measured, measured).level == "good"
    assert verdict_of(with_joint(0, 60.0, measured), measured).level == "refused"
    assert verdict_of(0 * TRUTH, 0 * TRUTH).level == "refused"


@pytest.mark.parametrize(("error", "level"), [(0.08, "good"), (0.2, "doubtful"), (0.22, "refused")])
def test_fit_that_is_worse_than_the_robots_file(error, level):
    file = TRUTH + 0.15 * SCALE
    verdict = verdict_of(TRUTH + error * SCALE, file=file, noise=NOISE)
    assert verdict.level == level
    assert ("robot's file predicts held-out torques better" in verdict.reason) == (level != "good")


def test_exact_file_does_not_refuse_a_fit_to_rounding():
    assert verdict_of(TRUTH + 1e-9, TRUTH, file=TRUTH).level == "good"


def test_one_joint():
    verdict = judge(held_out(TRUTH[:, :1], MEASURED[:, :1]))
    assert verdict.level == "good" and "worst" not in verdict.reason


def test_worst_of_several():
    good, one, two = Verdict("good", "a"), Verdict("doubtful", "b", "mend b"), Verdict("doubtful", "c", "mend c")
    assert worst(good, good) == good
    assert worst(good, one, two) == Verdict("doubtful", "b; c", "mend b; mend c")
    bad = Verdict("refused", "d", "mend d")
    assert worst(one, bad, good) == bad
    assert str(FitRefused(bad)) == "the fit is refused: d; mend d"


def test_metrics_are_numbers():
    errors = held_out(TRUTH, MEASURED, noise=NOISE, file=TRUTH)
    metrics = verdict_metrics(errors, judge(errors))
    assert metrics["verdict"] == LEVELS.index("good") == 0
    assert metrics["noise_nmse"] == pytest.approx(0.0025, rel=0.05) and metrics["zero_nmse"] > 1
    assert all(isinstance(value, int | float) for value in metrics.values())
    assert "file_nmse" not in verdict_metrics(HeldOut(*errors[:3]), judge(errors))


def test_verdict_needs_samples():
    with pytest.raises(InputError, match="no held-out samples"):
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
    fast = 0.9 * np.sin(40 * np.pi * t + np.array([[0.0], [1.0]])).T
    verdict = judge(held_out(torque + fast, torque))
    assert verdict.level == "doubtful" and "--cutoff" in verdict.remedy and "sign" not in verdict.line
    wrong = judge(held_out(torque * [1, -1] + fast, torque))
    assert wrong.level == "refused" and "sign" in wrong.remedy
