"""What the report of uncertainties draws and reads is what it says, and its cases give their rows."""

import numpy as np
import pytest

from dln_jax.studies.uncertainty import arms, cases


def test_a_filtered_recording_is_the_motion_without_its_noise():
    random, t = np.random.default_rng(0), np.arange(0, 7, 0.004)
    clean = np.sin(np.outer(t, [1.0, 2.0]))
    found = arms.filtered(
        t, clean + 1e-4 * random.normal(size=clean.shape), 3 * clean, cutoff=8.0, rate=50.0, seconds=2.0
    )
    assert set(np.unique(found["trajectory"])) == {0, 1, 2}
    assert np.diff(found["t"]).mean() == pytest.approx(0.02)
    exact = -np.array([1.0, 4.0]) * np.sin(np.outer(found["t"], [1.0, 2.0]))
    assert np.sqrt(np.mean((found["qdd"] - exact) ** 2)) < 0.1
    np.testing.assert_allclose(found["tau"], 3 * np.sin(np.outer(found["t"], [1.0, 2.0])), atol=1e-3)


def test_a_simulated_arm_is_covered_and_its_far_motions_are_flagged():
    rows = {row.quantity: row for row in cases.simulated_arm("arm", 2, noise=0.3, unmodelled=False, splits=2).rows}
    assert rows["coverage_95_lowest_joint"].passed and rows["coverage_95_highest_joint"].passed
    assert rows["far_outside_share"].value > 0.9 > 0.5 > rows["outside_share"].value


def test_recordings_are_cases_where_their_files_are_given(tmp_path):
    names = [case.name for case in cases.cases(splits=1)]
    more = [case.name for case in cases.cases(splits=1, recorded_arm=tmp_path, recorded_pendulum=tmp_path)]
    assert set(more) - set(names) == {"rigid-tree/ur10", "rigid-tree/double-pendulum"}
