"""Some faults of logs are found, a sound log has none, and the detectors' error rates meet the bounds."""

import numpy as np
import pytest

from scripts.reports.robots import log_checks, other_logs


@pytest.mark.slow
def test_some_faults_are_found_and_sound_logs_have_none():
    for number in (1, 6):
        robot, arrays, rates = log_checks.drawn(number)
        for known in (None, robot):
            assert not [f for f in log_checks.findings(arrays, known) if f.check not in log_checks.STATEMENTS]
    for kind in ("swapped-columns", "saturated-torque", "rates-exchanged", "tilted-base"):
        seen, spoiled = log_checks.spoiled(kind, robot, arrays, rates, np.random.default_rng(0))
        assert log_checks.FAULTS[kind] in [f.check for f in log_checks.findings(spoiled, seen)], kind


def test_stamps_of_arrival_and_repeated_motions_are_found():
    stamps = other_logs.arrival(stamped_logs=3)["log-checks/arrival"]
    assert stamps["found"] == 1 and stamps["false_alarms"] == 0 and stamps["error_left"] < 0.1
    repeats = other_logs.repeated_motions(sets=1)["log-checks/repeated-motions"]
    assert repeats["found"] >= 0.9 and repeats["wrongly_joined"] <= 0.02
