"""Commands of reports: what they refuse, what they write, and bounds that do not depend on the machine."""

import os
import subprocess

import numpy as np
import pytest
from calls import assert_refused, command, json_of, refused
from conftest import slow_among

from dln_jax.data import schema
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import pendulum
from dln_jax.training import low_latency_calls
from dln_jax.types import InputError
from scripts.reports import scale
from scripts.reports.case import Findings, named
from scripts.reports.commands import (
    arm_table,
    benchmark,
    control_report,
    hnn_table,
    robot_report,
    scale_report,
    softbody_report,
    stability,
)
from scripts.reports.process import called
from scripts.reports.rows import Row
from scripts.reports.turns import medians_in_turns

UNKNOWN = {"--only nonsense": "'nonsense' is unknown; choose from"}
MISTAKES = {
    arm_table: {
        "--data pendulum.npz": "that of the two-link arm",
        "--seeds 0": "seeds is 0",
        "--splits 21": "20 trajectories cannot be cut into 21 tests",
    },
    control_report: UNKNOWN,
    hnn_table: {
        "--tasks spring,pixel": "--tasks: 'pixel' is unknown",
        "--seeds 0": "seeds is 0",
        "--tasks real-pendulum": "needs its data",
        "--real-pendulum missing.npz": "no such file",
        "--real-pendulum double.npz": "has 2 coordinates",
        "--tasks two-body --trajectories 3": "trajectories is 3",
        "--tasks spring --own .": "has no files such as spring-101.npz",
    },
    robot_report: {
        **UNKNOWN,
        "--log log.npz": "--log and --robot belong together",
        "--log no.npz --robot no.urdf": "no.npz: no such file",
        "--only recordings": "recordings without any",
    },
    scale_report: {
        "--lanes 8,x": "--lanes is '8,x'",
        "--sharing 0": "sharing is 0",
        "--only teapots": "teapots",
    },
    softbody_report: {**UNKNOWN, "--only ,": "names nothing"},
    stability: {**UNKNOWN, "--steps 0": "steps is 0"},
}


def test_mistakes_are_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    swings = generators.uniform(pendulum(), samples=20)
    schema.save("pendulum.npz", swings)
    np.savez("double.npz", t=np.arange(20.0), trajectory=np.zeros(20, int), q=np.tile(swings.q, 2))
    for script, rows in MISTAKES.items():
        assert_refused(capsys, script, rows.items(), out=tmp_path / "no")


def test_a_subject_writes_its_report_and_table(tmp_path, monkeypatch, capsys):
    rows = [Row("a/b", "p50_us", np.nan, "us", None, 2.0), Row("a/b", "ratio", 2.0, "1"), Row("c", "ratio", 4.0, "1")]
    monkeypatch.setitem(benchmark.SUBJECTS, "integrators", lambda quick: Findings(rows))
    out = tmp_path / "out"
    command(benchmark, "integrators", "--quick --out", out)
    report = json_of(out / "report.json")
    assert {"case", "quantity", "value", "unit", "reference", "bound", "pass"} == set(report["rows"][0])
    assert report["rows"][0]["pass"] is False and report["conditions"]["quick"] is True
    title, *_, last = (out / "integrators.md").read_text().splitlines()
    assert title == "| case | p50 us, us | ratio |" and last == "| integrators/c |  | 4 |"
    assert "already contains" in refused(capsys, benchmark, "integrators", "--out", out)


def test_programs_and_works_take_turns():
    order = []
    programs = {name: (lambda _, name=name: order.append(name)) for name in ("one", "other")}
    medians_in_turns(programs, (0,), repetitions=2, warm_up=1)
    works = {name: scale.Work(lambda name=name: name, order.append, 2) for name in ("one", "other")}
    scale.medians(works, 2)
    assert order == ["one", "other"] * 6


def test_a_function_is_called_in_a_process_of_its_own():
    assert called(os.getenv, "OWN", OWN="yes") == "yes"
    with pytest.raises(InputError, match="ZeroDivisionError"):
        called(divmod, 1, 0)


def test_a_process_that_fails_leaves_the_row_out_with_a_reason(tmp_path, monkeypatch):
    for outcome, reason in (
        (FileNotFoundError("no python"), "no python"),
        (subprocess.TimeoutExpired("python", 1), "no answer in 120 s"),
        ((2, b"", b"x\nerror: no model\n"), "exit status 2: error: no model"),
        ((-9, b"", b""), "exit status -9: it printed nothing"),
        ((0, b"hello", b""), "Expecting value"),
        ((0, b"{}", b""), "p50_us"),
    ):

        def failing(command, outcome=outcome, **_):
            if isinstance(outcome, Exception):
                raise outcome
            return subprocess.CompletedProcess(command, *outcome)

        monkeypatch.setattr(low_latency_calls.subprocess, "run", failing)
        said = []
        assert low_latency_calls.low_latency_metrics(tmp_path, (np.zeros((3, 2)),), said.append) == {}
        assert len(said) == 1 and reason in said[0] and "\n" not in said[0]


# Speed, compilation and rivals depend on the machine; other tests cover locking, slender beams, impact and gripper;
# the rest of contact takes minutes.
ELSEWHERE = ("speed/", "compilation/", "rivals/", "references/locking", "references/slender", "contact/")
CASES = [case.name for case in softbody_report.cases() if not case.name.startswith(ELSEWHERE)] + ["contact/sliding"]
LONG = ("gradients/crawler", "hard/chain", "hard/materials", "contact/sliding")


@pytest.mark.parametrize("name", slow_among(CASES, LONG.__contains__))
def test_soft_bodies_meet_their_bounds(name):
    (case,) = named(softbody_report.cases(quick=True), name)
    rows = case.measure().rows
    assert rows and all(row.passed for row in rows)
