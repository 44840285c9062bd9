"""The report of robots: what it refuses, and how its rows come of what was measured."""

import numpy as np
import pytest
from calls import assert_refused

from scripts.reports.commands import robot_report
from scripts.reports.robots.known_kinematics import rows_of_errors
from scripts.reports.robots.recorded_arm import rows_of


def test_mistakes_are_one_line(capsys, tmp_path):
    rows = {
        "--only nonsense": "'nonsense' is unknown; choose from",
        "--log log.npz": "--log and --robot belong together",
        "--log no.npz --robot no.urdf": "no.npz: no such file",
        "--only recordings": "recordings without any",
    }
    assert_refused(capsys, robot_report, rows.items(), out=tmp_path / "run")


def test_errors_are_held_against_the_rival():
    errors = {"ours": [np.full(7, 1e-3), np.full(7, 2e-3)], "pinocchio": [np.full(7, 2e-3), np.full(7, 2e-3)]}
    rows = {(row.case.split("/")[-1], row.quantity): row for row in rows_of_errors(errors, 2)}
    assert rows["ours", "nmse"].value == pytest.approx(1.5e-3) and rows["ours", "nmse"].passed
    assert rows["ours", "nmse_worst"].value == pytest.approx(2e-3)
    assert rows["ours", "over_pinocchio"].value == pytest.approx(0.75)


def test_blocks_count_by_the_whole_logs_variance():
    sizes = {"usual-friction": [4.0, 1.0], "chosen-friction": [2.0, 1.0], "with-residual": [1.0, 1.0]}
    squares = {name: [np.full((10, 2), size) for size in each] for name, each in sizes.items()}
    rows = {(row.case.split("/")[-1], row.quantity): row for row in rows_of(squares, np.array([10.0, 10.0]), "ab")}
    assert rows["usual-friction", "nmse"].value == pytest.approx(0.25)
    assert rows["usual-friction", "nmse_worst_blocks"].value == pytest.approx(0.4)
    assert rows["with-residual", "over_without"].value == pytest.approx(2 / 3)
