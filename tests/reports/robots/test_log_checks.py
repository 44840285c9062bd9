"""Some faults of logs are found, a sound log has none, and the detectors' error rates meet the bounds."""

from scripts.reports.robots import log_checks


def test_stamps_of_arrival_and_repeated_motions_are_found():
    stamps = log_checks.arrival(stamped_logs=3)["log-checks/arrival"]
    assert stamps["found"] == 1 and stamps["false_alarms"] == 0 and stamps["error_left"] < 0.1
    repeats = log_checks.repeated_motions(sets=2)["log-checks/repeated-motions"]
    assert repeats["found"] >= 0.9 and repeats["wrongly_joined"] <= 0.02
