"""The report of robots: what it refuses, and how its rows come of what was measured."""

import numpy as np
import pytest
from calls import assert_refused

from scripts.reports.commands import robot_report
from scripts.reports.robots import log_checks
from scripts.reports.robots.known_kinematics import rows_of_errors, rows_of_tracking
from scripts.reports.robots.recorded_arm import rows_of


def test_mistakes_are_one_line(capsys, tmp_path):
    rows = [
        ("--only nonsense", "'nonsense' is unknown; choose from"),
        ("--log log.npz", "--log and --robot belong together"),
        ("--log no.npz --robot no.urdf", "no.npz: no such file"),
        ("--only recordings", "recordings without any"),
    ]
    assert_refused(capsys, robot_report, rows, out=tmp_path / "run")


def test_recordings_are_cases_where_they_are_given(tmp_path):
    options = robot_report.Arguments(log=tmp_path, robot=tmp_path, double_pendulum=tmp_path)
    names = {case.name for case in robot_report.cases(options)}
    assert names - {case.name for case in robot_report.cases()} == {
        "recordings/arm",
        "recordings/double-pendulum",
        "recordings/identify-by",
    }


def test_errors_are_held_against_the_rival():
    errors = {"ours": [np.full(7, 1e-3), np.full(7, 2e-3)], "pinocchio": [np.full(7, 2e-3), np.full(7, 2e-3)]}
    rows = {(row.case.split("/")[-1], row.quantity): row for row in rows_of_errors(errors, 2)}
    assert rows["ours", "nmse"].value == pytest.approx(1.5e-3) and rows["ours", "nmse"].passed
    assert rows["ours", "nmse_worst"].value == pytest.approx(2e-3)
    assert rows["ours", "over_pinocchio"].value == pytest.approx(0.75)


def test_tracking_is_held_against_true_parameters():
    rows = rows_of_tracking({"true-parameters": [1.0, 2.0], "ours": [1.2, 2.4], "without": [20.0, 30.0]})
    assert rows[-1].value == pytest.approx(1.2) and rows[-1].passed is False


@pytest.mark.slow
def test_some_faults_of_logs_are_found_and_a_sound_log_has_none():
    for number in (1, 6):
        log = log_checks.drawn(number, repeats=number == 1)
        assert log_checks.false_findings(log, None) == []
    assert log_checks.false_findings(log, log.robot) == []
    for kind in ("swapped-columns", "flipped-sign", "saturated-torque", "rates-exchanged"):
        fault, checks, inputs = log_checks.FAULTS[kind]
        assert set(checks) & set(log_checks.planted(log_checks.drawn(1, repeats=False), fault, inputs, 0)), kind


def test_blocks_count_by_the_whole_logs_variance():
    squares = {
        "usual-friction": [np.full((10, 2), 4.0), np.full((10, 2), 1.0)],
        "chosen-friction": [np.full((10, 2), 2.0), np.full((10, 2), 1.0)],
        "with-residual": [np.full((10, 2), 1.0), np.full((10, 2), 1.0)],
        "pinocchio": [np.full((10, 2), 2.0), np.full((10, 2), 2.0)],
    }
    rows = {(row.case.split("/")[-1], row.quantity): row for row in rows_of(squares, np.array([10.0, 10.0]), "ab")}
    assert rows["usual-friction", "nmse"].value == pytest.approx(0.25)
    assert rows["usual-friction", "nmse"].passed is False
    assert rows["usual-friction", "nmse_worst_blocks"].value == pytest.approx(0.4)
    assert rows["with-residual", "over_without"].value == pytest.approx(2 / 3)
