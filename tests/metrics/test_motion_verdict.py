"""Verdicts of predicted motions: an explosion is never averaged away, and neither chaos nor noise is a failure."""

import numpy as np
import pytest

from dln_jax.metrics.phase_space import Motions
from dln_jax.metrics.verdict import judge_motions

T = np.linspace(0, 10, 200)
PHASES = np.linspace(0, 6, 8)[:, None]
TRUE = Motions(T, np.cos(T + PHASES)[..., None], -np.sin(T + PHASES)[..., None])
SIZE = np.full(2, 2**-0.5)


def level(predicted, *, angle=False, noise=None):
    bounded = np.array([not angle, True])
    return judge_motions([predicted], [TRUE], size=SIZE, bounded=bounded, noise=noise).level


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
