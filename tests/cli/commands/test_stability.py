"""The double pendulum is predicted for as long as its Lyapunov exponent allows; the command line."""

import json
import math

import pytest
from calls import command, refused

from scripts.reports.commands import stability
from scripts.reports.rows import expect


def test_a_number_that_is_not_one_meets_no_bound():
    for at_least in (False, True):
        assert expect("a", "b", "", math.nan, 1.0, at_least=at_least).passed is False
    assert expect("a", "b", "", 1.0, 1.0).passed and not expect("a", "b", "", 1.0, 2.0, at_least=True).passed


@pytest.mark.slow
def test_the_script_writes_its_report(tmp_path, capsys):
    command(stability, "--only", "lyapunov-time", "--steps", "20000", "--out", tmp_path / "run")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert len(report["rows"]) == len(report["conditions"]["expected"]) == 7
    assert len({(row["case"], row["quantity"]) for row in report["rows"]}) == 7
    assert all(row["pass"] for row in report["rows"])
    assert "7 of 7 pass" in capsys.readouterr().out


def test_the_script_refuses_bad_input(tmp_path, capsys):
    assert "'nonsense' is unknown; choose from" in refused(
        capsys, stability, "--only", "nonsense", "--out", tmp_path / "a"
    )
    assert "names nothing" in refused(capsys, stability, "--only", ",", "--out", tmp_path / "a")
    assert "steps is 0" in refused(capsys, stability, "--steps", "0", "--out", tmp_path / "a")
    assert not (tmp_path / "a").exists()
