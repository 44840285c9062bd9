"""The benchmarks' own parts: the full-Hessian reference, integrators in one program for every dt, reports and paths."""

import json
import os
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import command, refused

from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.natural import lagrangian
from dln_jax.metrics.latency import one_step
from dln_jax.metrics.phase_space import Motions
from dln_jax.models.lagrangian import make_delan
from dln_jax.scenes.pendulums import chain
from dln_jax.training import low_latency_calls
from dln_jax.training.hamiltonian.tasks import Problem
from dln_jax.types import InputError, Needs
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import save
from scripts.reports.arm.models import described
from scripts.reports.arm.table import letters, published_split
from scripts.reports.case import Findings
from scripts.reports.commands import benchmark
from scripts.reports.commands.benchmark import SUBJECTS
from scripts.reports.process import called
from scripts.reports.rows import Row, markdown
from scripts.reports.speed import costs as benchmark_costs
from scripts.reports.speed import integrators as benchmark_integrators
from scripts.reports.speed import one_step as benchmark_one_step
from scripts.reports.turns import medians_in_turns


def test_the_full_hessian_way_gives_the_same_torques(d=2):
    model = make_delan(chain(d).needs, width=3, depth=1, dtype=jnp.float64)
    energies = model.energies(model.init(jax.random.key(0)))
    system = dynamics(energies)
    state = tuple(jnp.asarray(row) for row in np.random.default_rng(0).standard_normal((3, d)))
    reference = benchmark_costs.by_full_hessian(lagrangian(energies))
    both = lambda *state: (reference(*state), system.inverse_dynamics(*state))  # noqa: E731
    np.testing.assert_allclose(*jax.jit(both)(*state), rtol=1e-11, atol=1e-12)


def oscillator(q, p):
    return jnp.sum(0.5 * p**2 + 0.5 * q**2)


@pytest.mark.parametrize(("method", "order"), [("stormer-verlet", 2), ("rk4", 4)])
def test_halving_the_step_of_a_sweep_gains_by_the_order(method, order):
    t = np.linspace(0, 2, 51)
    truth = Motions(t, np.cos(t)[None, :, None], -np.sin(t)[None, :, None])
    problem = Problem("oscillator", Needs(("prismatic",)), None, None, None, (truth,), oscillator, oscillator)
    step = benchmark_integrators.step_of(method, oscillator, separable=True)
    swept = benchmark_integrators.sweep(problem, oscillator, step, dt=0.08, halvings=3)
    assert [round(swept[0][0] / dt) for dt, *_ in swept] == [1, 2, 4]
    errors = np.array([error for *_, error in swept])
    np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), order, atol=0.2)
    assert all(rate > 0 and drift < 1e-2 for _, rate, drift, _ in swept)
    assert benchmark_integrators.motions._cache_size() <= 2, "every step size has a program of its own"
    assert benchmark_integrators.step_of("stormer-verlet", oscillator, separable=False) is None


def test_a_subject_writes_its_report_and_table(tmp_path, monkeypatch, capsys):
    rows = [Row("a/b", "p50_us", 3.0, "us", None, 2.0), Row("a/b", "ratio", 2.0, "1"), Row("c", "ratio", 4.0, "1")]
    monkeypatch.setitem(SUBJECTS, "integrators", lambda quick: Findings(rows))
    command(benchmark, "integrators", "--quick", "--out", str(tmp_path / "out"))
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [row["case"] for row in report["rows"]] == ["integrators/a/b", "integrators/a/b", "integrators/c"]
    assert report["rows"][0]["pass"] is False and report["conditions"]["quick"] is True
    table = (tmp_path / "out" / "integrators.md").read_text()
    assert table == markdown([row._replace(case=f"integrators/{row.case}") for row in rows])
    assert (
        table.splitlines()[0] == "| case | p50 us, us | ratio |"
        and table.splitlines()[-1] == "| integrators/c |  | 4 |"
    )
    assert "already contains" in refused(capsys, benchmark, "integrators", "--out", str(tmp_path / "out"))


def test_programs_take_turns():
    order: list[str] = []
    programs = {name: (lambda _, name=name: order.append(name)) for name in ("one", "other")}
    assert set(medians_in_turns(programs, (0,), repetitions=2, warm_up=1)) == {"one", "other"}
    assert order == ["one", "other"] * 3
    found = one_step(lambda x: x, [(0,), (1,)], calls=10, warm_up=0)
    assert found.p50_us <= found.p99_us <= found.p999_us <= found.worst_us


def run_of(kind, place):
    """A run with random parameters."""
    (folder := place / kind).mkdir()
    description = described(kind, published_split(letters(None)).train, width=2, depth=1)
    save(folder, description, build(description).init(jax.random.key(0)))
    return folder


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    return run_of("structured-delan", tmp_path_factory.mktemp("runs"))


@pytest.mark.slow
def test_low_latency_is_timed_in_a_process_of_its_own(small_run):
    said = []
    states = (np.zeros((7, 2)), np.ones((7, 2)), np.ones((7, 2)))
    found = low_latency_calls.low_latency_metrics(small_run, states, said.append)
    assert not said
    assert 0 < found["one_step_low_latency_p50_us"] <= found["one_step_low_latency_p99_us"]


BROKEN = {
    "no such program": ({"side_effect": FileNotFoundError("no python")}, "no python"),
    "too slow": ({"side_effect": subprocess.TimeoutExpired("python", 1)}, "no answer in 120 s"),
    "a mistake": ({"returncode": 2, "stderr": b"x\nerror: no model\n"}, "exit status 2: error: no model"),
    "killed": ({"returncode": -9}, "exit status -9: it printed nothing"),
    "no answer": ({"stdout": b"hello"}, "Expecting value"),
    "no time": ({"stdout": b"{}"}, "p50_us"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_process_that_fails_leaves_the_row_out_with_a_reason(case, tmp_path, monkeypatch):
    outcome, reason = BROKEN[case]

    def failing(command, **_):
        if "side_effect" in outcome:
            raise outcome["side_effect"]
        return subprocess.CompletedProcess(command, **{"returncode": 0, "stdout": b"", "stderr": b"", **outcome})

    monkeypatch.setattr(low_latency_calls.subprocess, "run", failing)
    said = []
    assert low_latency_calls.low_latency_metrics(tmp_path, (np.zeros((3, 2)),), said.append) == {}
    assert len(said) == 1 and reason in said[0] and "\n" not in said[0]


@pytest.mark.slow
def test_call_paths_are_timed(small_run, tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark_one_step, "enable_low_latency", lambda: None)  # a process of its own would be needed
    folders = list(map(str, (small_run, run_of("feed-forward", tmp_path))))
    times = [benchmark_one_step.times_of_runs(folders, way, 10) for way in ("default", "low-latency")]
    first, second = (turn["structured-delan"] for turn in times)
    assert set(first) == {"default-jit"}
    assert {"low-latency-jit", "low-latency-numpy", "c-from-python", "c-loop"} == set(second)
    assert second["c-loop"]["calls_per_second"] > 0
    assert set(times[1]["feed-forward"]) == set(second)
    merged = benchmark_one_step.over_processes([first, second, second])
    assert merged["c-from-python"]["p50_spread_us"] == 0 and set(merged) == {*first, *second}
    rows = [
        row
        for path, numbers in merged.items()
        for row in benchmark_one_step.rows_of(f"structured-delan/{path}", numbers)
    ]
    bounds = {row.case: row.bound for row in rows if row.bound is not None}
    assert bounds == {"structured-delan/c-loop": 1_500_000.0}
    assert {row.quantity for row in rows} >= {"inverse_p50_us", "inverse_p999_us", "inverse_calls_per_second"}


def test_a_function_is_called_in_a_process_of_its_own():
    assert called(os.getenv, "OWN", OWN="yes") == "yes"
    with pytest.raises(InputError, match="ZeroDivisionError"):
        called(divmod, 1, 0)
