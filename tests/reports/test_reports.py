"""Reports: tables of cases that can be told apart, and the run that measures, stores, resumes and judges them."""

import importlib
import inspect
import json
import math
import sys
from pathlib import Path

import pytest
from calls import json_of

from dln_jax.errors import InputError
from dln_jax.files import write_json
from scripts.report import NAMES, PAGE, TEMPLATES, fill_page, measured_below
from scripts.reports import run
from scripts.reports.run import AtLeast, Case, report

TABLES = {name: importlib.import_module(f"scripts.reports.cases.{name}").CASES for name in NAMES}


@pytest.mark.parametrize("name", NAMES)
def test_cases_have_names_of_their_own_and_settings_that_their_functions_take(name):
    names = [case.name for case in TABLES[name]]
    assert names and len(set(names)) == len(names)
    for case in TABLES[name]:
        assert case.name == case.name.lower() and " " not in case.name
        assert {*case.settings, *case.quick} <= {*inspect.signature(case.function).parameters}, case.name


@pytest.fixture
def table(monkeypatch, tmp_path):
    """A report of two cases, of which one counts its calls; returns a function that runs it, and the calls."""
    calls = []

    def fall(*, drops: int = 3, heights: tuple[str, ...] = ("low",), log: Path | None = None):
        calls.append((drops, heights, log))
        return {f"fall/{height}": {"error": 0.1 * drops, "share": 0.6, "mass": 2.0} for height in heights}

    cases = (
        Case(
            "fall/free",
            fall,
            quick={"drops": 1},
            published={"error": 0.25},
            bound={"error": 0.2, "fall/high error": 1.0, "share": AtLeast(0.5)},
        ),
        Case("other/nothing", lambda: {"other": {"error_seconds": math.nan}}, bound={"error_seconds": 1.0}),
    )

    class Module:
        """Measure how stones fall."""

        CASES = cases

    monkeypatch.setitem(sys.modules, "scripts.reports.cases.stones", Module)
    monkeypatch.chdir(tmp_path)

    def called(*words):
        monkeypatch.setattr(sys, "argv", ["report", *map(str, words)])
        report("stones")
        return json_of(tmp_path / "runs/stones-1/report.json") if "--out" not in words else None

    return called, calls


def refused(table, capsys, *words):
    with pytest.raises(SystemExit) as stop:
        table[0](*words)
    line = capsys.readouterr().err
    assert stop.value.code == 2 and line.startswith("error: ") and line.count("\n") == 1
    return line


def test_rows_stand_beside_published_numbers_and_bounds(table, capsys):
    written = table[0]("--heights", "low,high")
    rows = {(row["case"], row["quantity"]): row for row in written["rows"]}
    assert rows["fall/low", "error"] == {
        **{"case": "fall/low", "quantity": "error", "value": pytest.approx(0.3), "unit": "1"},
        **{"reference": 0.25, "bound": 0.2, "pass": False},
    }
    assert rows["fall/high", "error"]["pass"] and rows["fall/high", "share"]["pass"]
    # A number that is not one meets no bound.
    assert rows["other", "error_seconds"]["value"] is None and not rows["other", "error_seconds"]["pass"]
    assert rows["other", "error_seconds"]["unit"] == "s"
    assert rows["fall/low", "mass"]["pass"] is None
    assert {"machine", "versions"} <= {*written["conditions"]} and "3 of 5 pass" in capsys.readouterr().out


def test_options_are_the_keywords_of_the_functions(table, tmp_path):
    table[0]("fall", "--quick", "--log", "stones.csv")
    table[0]("--quick", "--drops", "7", "--out", tmp_path / "other", "--only", "fall")
    assert table[1] == [(1, ("low",), Path("stones.csv")), (7, ("low",), None)]


def test_mistakes_are_one_line(table, capsys):
    assert "'rise' is unknown; choose from fall, other" in refused(table, capsys, "--only", "rise")
    assert "--drops must be a whole number" in refused(table, capsys, "--drops", "many")
    assert "unrecognised option: --weights" in refused(table, capsys, "--weights", "3")


def test_an_interrupted_report_continues_with_what_was_measured(table, tmp_path, capsys):
    folder = tmp_path / "run"
    table[0]("--out", folder)
    table[0]("--out", folder, "--resume")
    assert len(table[1]) == 1
    stored = json_of(folder / run.JOBS)
    del stored["fall/free"]
    (folder / run.JOBS).write_text(json.dumps(stored))
    table[0]("--out", folder, "--resume")
    assert len(table[1]) == 2
    for damaged, words in (
        ({"rise/free": {}}, "'rise/free' is not a case of this run"),
        ({"fall/free": {"fall": {"error": "small"}}}, "Expected `float | null`, got `str`"),
        ({"fall/free": 1.0}, "Expected `object`, got `float`"),
    ):
        (folder / run.JOBS).write_text(json.dumps(damaged))
        assert words in refused(table, capsys, "--out", folder, "--resume")


def test_a_table_gets_the_numbers_that_were_measured(tmp_path, monkeypatch):
    low = {"case": "low", "quantity": "error", "value": 2.34e-5, "reference": 0.1}
    rows = [low, {**low, "case": "high", "value": None, "reference": None}, {**low, "case": "lost", "quantity": "time"}]
    write_json(tmp_path / "report.json", {"conditions": {"report": "arm", "quick": True}, "rows": rows})
    with pytest.raises(InputError, match="has no report"):
        measured_below(tmp_path)
    write_json(tmp_path / "report.json", {"conditions": {"report": "arm", "quick": False}, "rows": rows})
    cells = ["{* error} / {published * error}", "{*/x error}"]
    monkeypatch.setitem(TEMPLATES, "arm/errors", [cells, ["low", "high", "lost"]])
    table = "<!-- arm/errors -->\n\n| | a | b |\n|---|---|---|\n| 1 | 3 | 4 |\n| 2 | 3 | 4 |\n| 3 | 3 | 4 |\n"
    assert fill_page(table, measured_below(tmp_path)).splitlines()[-3:] == [
        "| 1 | 2.3e-5 / 0.1 | 4 |",
        "| 2 | not finite | 4 |",
        "| 3 | 3 | 4 |",
    ]


def test_tables_of_the_page_have_the_rows_and_columns_of_their_templates():
    page = PAGE.read_text()
    assert all(f"<!-- {name} -->" in page for name in TEMPLATES)
    assert fill_page(page, {name: {} for name in NAMES}) == page
