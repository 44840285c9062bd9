"""The double pendulum is predicted for as long as its Lyapunov exponent allows; the command line."""

import math

import pytest
from calls import assert_refused, command, json_of

from scripts.reports.commands import stability
from scripts.reports.rows import expect


def test_a_number_that_is_not_one_meets_no_bound():
    for at_least in (False, True):
        assert expect("a", "b", "", math.nan, 1.0, at_least=at_least).passed is False
    assert expect("a", "b", "", 1.0, 1.0).passed and not expect("a", "b", "", 1.0, 2.0, at_least=True).passed


@pytest.mark.slow
def test_the_script_writes_its_report(tmp_path):
    command(stability, "--only lyapunov-time --steps 20000 --out", tmp_path / "run")
    rows = json_of(tmp_path / "run" / "report.json")["rows"]
    assert len({(row["case"], row["quantity"]) for row in rows}) == 7 and all(row["pass"] for row in rows)


def test_the_script_refuses_bad_input(tmp_path, capsys):
    rows = {"--only nonsense": "'nonsense' is unknown; choose from", "--steps 0": "steps is 0"}
    assert_refused(capsys, stability, rows.items(), out=tmp_path / "a")
