"""The report of control: its cases, and what it refuses."""

import pytest
from calls import assert_refused

from dln_jax.control.closed_loop import hanging_starts
from scripts.reports.commands import control_report
from scripts.reports.control.swing_ups import SWING_UPS, tried


def test_an_unknown_subject_is_one_line(capsys, tmp_path):
    assert_refused(capsys, control_report, [("--only dance", "'dance' is unknown; choose from")], out=tmp_path / "run")


def test_every_subject_has_cases():
    names = [case.name for case in control_report.cases()]
    assert len(set(names)) == len(names) and {name.split("/")[0] for name in names} == set(control_report.SUBJECTS)


@pytest.mark.slow
def test_poles_come_up_on_hardware_from_encoders_alone():
    case = SWING_UPS["rotary-pendulum"]
    assert tried(case, hanging_starts(8, 0, position=case.position), seconds=3.0).share == 1
