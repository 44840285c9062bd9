"""Timing: programs take turns, and calls in a process of their own."""

import os
import subprocess

import jax
import numpy as np
import pytest

from dln_jax.metrics.latency import one_step
from dln_jax.training import low_latency_calls
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import save
from scripts.reports.arm.data import published_split
from scripts.reports.arm.models import described
from scripts.reports.process import called
from scripts.reports.timing import medians_in_turns


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
    description = described(kind, published_split().train, width=2, depth=1)
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


def test_a_function_is_called_in_a_process_of_its_own():
    assert called(os.getenv, "OWN", OWN="yes") == "yes"
    with pytest.raises(InputError, match="ZeroDivisionError"):
        called(divmod, 1, 0)
