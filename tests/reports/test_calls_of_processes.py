"""Measurements in processes of their own."""

import os
import subprocess

import numpy as np
from calls import one_line

from dln_jax.training import low_latency_calls
from scripts.reports.timing import called


def test_a_function_is_called_in_a_process_of_its_own():
    assert called(os.getenv, "OWN", OWN="yes") == "yes"
    with one_line("ZeroDivisionError"):
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
