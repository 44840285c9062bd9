"""Cases of soft bodies that do not depend on the machine, and the command line."""

import json

import pytest
from calls import command, refused

from dln_jax.commands import softbody_report
from dln_jax.studies.soft_bodies import SUBJECTS, measure
from dln_jax.types import InputError

# What test_minimise (modes), test_soft_body_identification (friction) and test_simulate (twists) assert.
ELSEWHERE = ("modes", "coulomb", "twist")
CASES = [
    (subject, name)
    for subject in ("references", "hard", "gradients")
    for name in SUBJECTS[subject]
    if name not in ELSEWHERE
]


@pytest.mark.parametrize(("subject", "name"), CASES, ids=[f"{subject}-{name}" for subject, name in CASES])
def test_soft_bodies_meet_their_bounds(subject, name):
    cases = measure(subject, name, quick=True).cases
    assert cases and len({(case.name, case.quantity) for case in cases}) == len(cases)
    failing = [(case.name, case.quantity, case.got, case.bound) for case in cases if not case.passed]
    assert not failing


def test_the_script_writes_its_report_and_figures(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(
        SUBJECTS, "references", {name: SUBJECTS["references"][name] for name in ("invariants", "slope")}
    )
    command(softbody_report, "--only", "references", "--quick", "--out", tmp_path / "run")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert len(report["rows"]) == len(report["conditions"]["expected"]) > 8
    assert {"case", "quantity", "value", "unit", "reference", "bound", "pass"} == set(report["rows"][0])
    assert (tmp_path / "run" / "invariants.png").read_bytes().startswith(b"\x89PNG")
    assert f" of {len(report['rows'])} pass" in capsys.readouterr().out


def test_refuses_bad_input(tmp_path, capsys):
    out = tmp_path / "a"
    assert "'nonsense' is unknown; choose from" in refused(capsys, softbody_report, "--only", "nonsense", "--out", out)
    assert "names nothing" in refused(capsys, softbody_report, "--only", ",", "--out", out)
    assert not out.exists()
    with pytest.raises(InputError, match="has no 'nonsense'"):
        measure("hard", "nonsense")
    with pytest.raises(InputError, match="'nonsense' is unknown"):
        measure("nonsense", "chain")
