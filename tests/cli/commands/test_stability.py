"""Every hard case, the report of missing friction, and the command line."""

import json
import math

import numpy as np
import pytest
from calls import command, refused
from conftest import slow_among

from dln_jax.types import InputError
from scripts.reports.case import named
from scripts.reports.commands import stability
from scripts.reports.commands.stability import NAMES, cases
from scripts.reports.rows import expect
from scripts.reports.stability.misfit import velocity_misfit

LONG = ("sizes", "float32", "lyapunov-time", "close-encounters", "batches")
LONG += ("mass-conditions", "not-finite", "turned-angles", "noise")
STEPS = {"separatrix": 5_000, "lyapunov-time": 20_000}


@pytest.mark.parametrize("name", slow_among(NAMES, LONG.__contains__))
def test_hard_cases_meet_their_bounds(name):
    (case,) = named(cases(steps=STEPS.get(name, 1)), name)
    rows = case.measure().rows
    assert rows and len({(row.case, row.quantity) for row in rows}) == len(rows)
    assert not [row for row in rows if not row.passed]


def test_a_number_that_is_not_one_meets_no_bound():
    for at_least in (False, True):
        assert expect("a", "b", "", math.nan, 1.0, at_least=at_least).passed is False
    assert expect("a", "b", "", 1.0, 1.0).passed and not expect("a", "b", "", 1.0, 2.0, at_least=True).passed


@pytest.mark.parametrize("friction", [0.0, 0.05])
def test_misfit_tells_friction_from_noise(friction):
    random = np.random.default_rng(0)
    qd, noise = random.uniform(-3, 3, (500, 2)), 0.1 * random.normal(size=(500, 2))
    found = velocity_misfit(qd, friction * qd + noise)
    assert found.missing.tolist() == [friction > 0] * 2
    assert found.coefficient == pytest.approx(friction, abs=0.02)


def test_misfit_is_not_misled_by_a_missing_potential_and_refuses_nonsense():
    t = np.linspace(0, 40 * np.pi, 2_000)[:, None]
    assert not velocity_misfit(np.cos(t), np.sin(t)).missing.any()
    assert velocity_misfit(np.cos(t), np.cos(t), np.arange(2_000) // 100).missing.all()
    with pytest.raises(InputError, match="expected the same"):
        velocity_misfit(np.zeros((2, 1)), np.zeros((2, 1)))


def test_the_script_writes_its_report(tmp_path, capsys):
    command(stability, "--only", "separatrix", "--steps", "300", "--out", tmp_path / "run")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert len(report["rows"]) == len(report["conditions"]["expected"]) == 8
    assert all(row["pass"] for row in report["rows"])
    assert "8 of 8 pass" in capsys.readouterr().out


def test_the_script_refuses_bad_input(tmp_path, capsys):
    assert "'nonsense' is unknown; choose from" in refused(
        capsys, stability, "--only", "nonsense", "--out", tmp_path / "a"
    )
    assert "names nothing" in refused(capsys, stability, "--only", ",", "--out", tmp_path / "a")
    assert "steps is 0" in refused(capsys, stability, "--steps", "0", "--out", tmp_path / "a")
    assert not (tmp_path / "a").exists()
