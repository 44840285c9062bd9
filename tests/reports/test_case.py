"""Cases: names that can be told apart, and what a broken table is continued from."""

import json

import numpy as np
import pytest

from dln_jax.types import InputError
from scripts.reports.arm import table as arm
from scripts.reports.case import JOBS, Case, Findings, by_case, measure, named, rows_of, stored_findings
from scripts.reports.commands import benchmark, softbody_report, stability
from scripts.reports.differential_networks import one_pass
from scripts.reports.differential_networks import table as differential_networks
from scripts.reports.hamiltonian import table as hamiltonian
from scripts.reports.published import ARM, DIFFERENTIAL_NETWORKS, HAMILTONIAN, published
from scripts.reports.speed import derivatives

STUDIES = (
    *(arm, differential_networks, one_pass, hamiltonian),
    *(derivatives, softbody_report, benchmark, stability),
)


@pytest.mark.parametrize("study", STUDIES, ids=lambda study: study.__name__)
def test_every_study_has_cases_with_names_of_their_own(study, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    names = [case.name for case in study.cases()]
    assert names and len(set(names)) == len(names)
    assert all(name == name.lower() and " " not in name for name in names)


def numbers(name, error):
    return Case(name, lambda: Findings(rows_of(name, {"error": error})), {name: ["error"]})


def test_a_table_is_continued_with_what_was_measured(tmp_path):
    first, second = numbers("a", 1.0), numbers("b", float("nan"))
    told = []
    measure([first, second], lambda done: told.append(done.place), folder=tmp_path)
    stored = stored_findings(tmp_path, [first, second])
    assert told == ["1/2", "2/2"] and np.isnan(by_case(stored["b"].rows)["b"]["error"])
    assert stored["a"].rows == rows_of("a", {"error": 1.0})
    again = measure([numbers("a", 2.0), second], told.append, folder=tmp_path, resume=True)
    assert list(again) == ["a", "b"] and again["a"].rows == stored["a"].rows
    assert stored_findings(tmp_path / "none", [first]) == {}


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        ({"c": {}}, "'c' is not a case"),
        ({"a": {"error": 1.0}}, "expected rows"),
        ({"a": {"rows": [["a", "error", "small"]]}}, "expected rows"),
        ({"a": {"rows": [["a", "other", 1.0]]}}, "a lacks error"),
        ({"a": {"rows": [["b", "error", 1.0]]}}, "'b' is not a case of a"),
    ],
)
def test_a_damaged_table_is_refused(tmp_path, stored, message):
    (tmp_path / JOBS).write_text(json.dumps(stored))
    with pytest.raises(InputError, match=message):
        stored_findings(tmp_path, [numbers("a", 1.0)])


def test_a_case_that_there_is_not_is_refused():
    with pytest.raises(InputError, match="'c' is unknown; choose from a, b"):
        named([numbers("a", 1.0), numbers("b", 1.0)], "b", "c")


def test_published_numbers_are_found_by_case_and_quantity():
    assert published(ARM, "structured-hnn/characters", "torque_from_momenta_mse") == 5.4e-6
    assert published(HAMILTONIAN, "two-body/black-box-hnn", "energy_mse") == 3.9e-5
    assert published(DIFFERENTIAL_NETWORKS, "sin/type2/cos", "value_mse") == 1.7e-8
    assert published(ARM, "structured-hnn/characters", "torque_mse") is None
    assert published(ARM, "trigonometric/characters", "torque_mse") is None
