"""The table of own files beside the named tasks."""

import numpy as np
import pytest

from scripts.reports.case import rows_of
from scripts.reports.commands import hnn_table
from scripts.reports.hamiltonian.own_files import with_bounds
from scripts.reports.rows import markdown
from tests.calls import command, json_of, refused
from tests.published_motions import published_arrays


def test_a_folder_without_files_is_refused(tmp_path, capsys):
    line = refused(capsys, hnn_table, "--own", tmp_path, "--tasks spring --out", tmp_path / "table")
    assert "has no files such as spring-101.npz" in line and not (tmp_path / "table").exists()


def test_own_files_are_held_to_twice_the_error_of_the_named_task():
    errors = {"named-task": 1e-5, "own-files": 1.9e-5, "own-files-without-needs": 2.1e-5}
    rows = [
        row
        for kind, error in errors.items()
        for row in rows_of(f"spring/{kind}", {"energy_mse": error, "energy_mse_largest": 2 * error})
    ]
    passed = {row.case: row.passed for row in with_bounds(rows) if row.passed is not None}
    assert passed == {"spring/own-files": True, "spring/own-files-without-needs": False}
    assert "| spring/own-files | 1.9e-05 / 1e-05 | 3.8e-05 |" in markdown(with_bounds(rows))


@pytest.mark.slow
def test_own_orbits_are_judged_on_the_starts_of_the_named_task(tmp_path, monkeypatch):
    """Files go axis by axis and the task body by body: what was learned from one predicts the other exactly."""
    monkeypatch.chdir(tmp_path)
    np.savez("two-body-7.npz", **published_arrays("two-body", 7, trajectories=30))
    command(hnn_table, "--own . --tasks two-body --seeds 1 --steps 30 --out table")
    rows = json_of(tmp_path / "table" / "report.json")["rows"]
    numbers = {row["case"]: row["value"] for row in rows if row["quantity"] == "energy_mse"}
    assert set(numbers) == {"two-body/named-task", "two-body/own-files", "two-body/own-files-without-needs"}
    assert max(numbers.values()) < 1e-9
