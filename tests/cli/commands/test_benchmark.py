"""The benchmarks' own parts: the full-Hessian reference, integrators in one program for every dt, reports and paths."""

import os
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import command, json_of, refused

from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.natural import lagrangian
from dln_jax.models.lagrangian import make_delan
from dln_jax.scenes.pendulums import chain
from dln_jax.training import low_latency_calls
from dln_jax.types import InputError
from scripts.reports.case import Findings
from scripts.reports.commands import benchmark
from scripts.reports.commands.benchmark import SUBJECTS
from scripts.reports.process import called
from scripts.reports.rows import Row
from scripts.reports.speed import costs as benchmark_costs
from scripts.reports.turns import medians_in_turns


def test_the_full_hessian_way_gives_the_same_torques(d=2):
    model = make_delan(chain(d).needs, width=3, depth=1, dtype=jnp.float64)
    energies = model.energies(model.init(jax.random.key(0)))
    system = dynamics(energies)
    state = tuple(jnp.asarray(row) for row in np.random.default_rng(0).standard_normal((3, d)))
    reference = benchmark_costs.by_full_hessian(lagrangian(energies))
    both = lambda *state: (reference(*state), system.inverse_dynamics(*state))  # noqa: E731
    np.testing.assert_allclose(*jax.jit(both)(*state), rtol=1e-11, atol=1e-12)


def test_a_subject_writes_its_report_and_table(tmp_path, monkeypatch, capsys):
    rows = [Row("a/b", "p50_us", 3.0, "us", None, 2.0), Row("a/b", "ratio", 2.0, "1"), Row("c", "ratio", 4.0, "1")]
    monkeypatch.setitem(SUBJECTS, "integrators", lambda quick: Findings(rows))
    out = tmp_path / "out"
    command(benchmark, "integrators", "--quick --out", out)
    report = json_of(out / "report.json")
    assert [row["case"] for row in report["rows"]] == ["integrators/a/b", "integrators/a/b", "integrators/c"]
    assert report["rows"][0]["pass"] is False and report["conditions"]["quick"] is True
    lines = (out / "integrators.md").read_text().splitlines()
    assert (lines[0], lines[-1]) == ("| case | p50 us, us | ratio |", "| integrators/c |  | 4 |")
    assert "already contains" in refused(capsys, benchmark, "integrators", "--out", out)


def test_programs_take_turns():
    order: list[str] = []
    programs = {name: (lambda _, name=name: order.append(name)) for name in ("one", "other")}
    assert set(medians_in_turns(programs, (0,), repetitions=2, warm_up=1)) == {"one", "other"}
    assert order == ["one", "other"] * 3


BROKEN = [
    (FileNotFoundError("no python"), "no python"),
    (subprocess.TimeoutExpired("python", 1), "no answer in 120 s"),
    ((2, b"", b"x\nerror: no model\n"), "exit status 2: error: no model"),
    ((-9, b"", b""), "exit status -9: it printed nothing"),
    ((0, b"hello", b""), "Expecting value"),
    ((0, b"{}", b""), "p50_us"),
]
"""Ends of a process, (status, output, errors), and reasons."""


def test_a_process_that_fails_leaves_the_row_out_with_a_reason(tmp_path, monkeypatch):
    for outcome, reason in BROKEN:

        def failing(command, outcome=outcome, **_):
            if isinstance(outcome, Exception):
                raise outcome
            return subprocess.CompletedProcess(command, *outcome)

        monkeypatch.setattr(low_latency_calls.subprocess, "run", failing)
        said = []
        assert low_latency_calls.low_latency_metrics(tmp_path, (np.zeros((3, 2)),), said.append) == {}
        assert len(said) == 1 and reason in said[0] and "\n" not in said[0]


def test_a_function_is_called_in_a_process_of_its_own():
    assert called(os.getenv, "OWN", OWN="yes") == "yes"
    with pytest.raises(InputError, match="ZeroDivisionError"):
        called(divmod, 1, 0)
