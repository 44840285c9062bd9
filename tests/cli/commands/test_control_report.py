"""The report of control: its cases, and what it refuses."""

from calls import refused

from scripts.reports.commands import control_report
from scripts.reports.control.cases import SWING_UPS, cases
from scripts.reports.control.energy_laws import success


def test_an_unknown_subject_is_one_line(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "'dance' is unknown; choose from" in refused(capsys, control_report, "--only", "dance", "--out", "run")
    assert not (tmp_path / "run").exists()


def test_every_subject_has_cases():
    assert {case.name.split("/")[0] for case in cases()} == set(control_report.SUBJECTS)


def test_poles_come_up_on_hardware_from_encoders_alone():
    assert success(SWING_UPS["rotary-pendulum"], 8, seconds=3.0).share == 1
