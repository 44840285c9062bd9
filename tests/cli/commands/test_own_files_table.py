"""The table of own files beside the named tasks."""

from scripts.reports.case import rows_of
from scripts.reports.commands import hnn_table
from scripts.reports.hamiltonian.own_files import with_bounds
from tests.calls import refused


def test_a_folder_without_files_is_refused(tmp_path, capsys):
    line = refused(capsys, hnn_table, "--own", tmp_path, "--tasks spring --out", tmp_path / "table")
    assert "has no files such as spring-101.npz" in line and not (tmp_path / "table").exists()


def test_own_files_are_held_to_twice_the_error_of_the_named_task():
    errors = {"named-task": 1e-5, "own-files": 1.9e-5, "own-files-without-needs": 2.1e-5}
    rows = [row for kind, error in errors.items() for row in rows_of(f"spring/{kind}", {"energy_mse": error})]
    passed = {row.case: row.passed for row in with_bounds(rows) if row.passed is not None}
    assert passed == {"spring/own-files": True, "spring/own-files-without-needs": False}
