"""The comparison with CasADi's C: both compute the same step, and the faster of CasADi's programs is the rival."""

import shutil
from collections import Counter

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.scenes import closed_form_forward_dynamics, two_link_arm
from scripts.reports.speed.calls_in_c import Times, compiled, programs, timed
from scripts.reports.speed.casadi_in_c import CASE, STEP, casadi_step, ours, rows_of, textbook_rates

needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler on the PATH"
)


def test_the_textbook_rates_are_those_of_the_scene():
    random, rates = np.random.default_rng(0), textbook_rates()
    for x, u in zip(random.normal(size=(5, 4)), random.normal(size=(5, 2)), strict=True):
        qdd = closed_form_forward_dynamics(two_link_arm(), *jnp.split(x, 2), jnp.asarray(u))
        np.testing.assert_allclose(rates(jnp, x, u), [*x[2:], *qdd], rtol=1e-12)


@needs_compiler
def test_casadi_computes_the_same_numbers_by_its_own_derivatives(tmp_path):
    pytest.importorskip("casadi", reason="the functions are compared in CasADi, of the extra [test]")
    from dln_jax.export.c.source import export_c

    model, kinds = casadi_step(tmp_path / "casadi", shared=True)
    export_c({STEP: ours()["closed-form"]}, tmp_path / "ours", finite=True)
    folders = {tmp_path / "ours": compiled(tmp_path / "ours", tmp_path / "ours"), model.parent: model}
    effort = {"repeats": 1, "calls": 1, "cold": 1, "mebibytes": 1}
    sums = [timed(programs(folder, built, [STEP])[STEP], **effort).sum for folder, built in folders.items()]
    np.testing.assert_allclose(*sums, rtol=1e-12)
    assert kinds["functions"] == 24 and kinds.total() > 1000  # sine and cosine of three angles, four times


def test_the_faster_program_of_casadi_is_the_rival():
    def times(ns):
        return [Times(np.full(3, ns * turn), np.full(5, 10 * ns), 1.0, 7.0, "gcc 1") for turn in (1.0, 1.1)]

    kinds = {"energies": Counter(additions=30), "casadi": Counter(additions=60), "casadi-shared": Counter(additions=50)}
    rows = rows_of({"energies": times(90.0), "casadi": times(100.0), "casadi-shared": times(120.0)}, kinds)
    found = {(row.case, row.quantity): row for row in rows}
    ratio = found[f"{CASE}/energies", "over_casadi"]
    np.testing.assert_allclose((ratio.value, ratio.bound), (0.9, 1.0))
    assert found[f"{CASE}/energies", "operations_over_casadi"].value == 30 / 50
    assert (f"{CASE}/casadi", "over_casadi") not in found
