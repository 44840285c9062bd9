"""Timing of exported C: its program by a clock of known pace, the bounds of its rows, rivals, and what it refuses."""

import shutil

import numpy as np
import pytest
from calls import refused

from dln_jax.types import InputError
from scripts.reports.commands import benchmark
from scripts.reports.robots import pinocchio
from scripts.reports.speed import exported_c
from scripts.reports.speed.calls_in_c import (
    LARGEST,
    SMALLEST,
    Prototype,
    Times,
    compiled,
    evicting,
    programs,
    prototypes,
    timed,
)
from scripts.reports.speed.exported_c import ARMS, FORWARD, FUNCTIONS, INVERSE, JACOBIAN, OTHERS, OURS, RIVALLED, Arm

needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler on the PATH"
)
HEADER = """
/* double model_comment(const double q[1]); */
void model_inverse_dynamics(const double q[2], const double qd[2],
                            const double qdd[2], double tau[2]);
double model_energy(const double q[2], const double qd[2]);
void model_mass_matrix(const float q[3], float M[3 * 3]);
void model_step_rk4(const double x[4], double dt, double x_next[4], double A[16]);
void model_mixed(const float q[3], double M[9]);
int model_external(const double **arg, double **res, long long *iw, double *w, int mem);
void model_long_inverse(const double q[2], double tau[2]);
"""


def test_functions_are_found_in_a_header():
    found = prototypes(HEADER, "model")
    assert found == {
        "inverse_dynamics": Prototype("double", {"q": 2, "qd": 2, "qdd": 2}, {"tau": 2}, False),
        "energy": Prototype("double", {"q": 2, "qd": 2}, {}, True),
        "mass_matrix": Prototype("float", {"q": 3}, {"M": 9}, False),
        "step_rk4": Prototype("double", {"x": 4, "dt": 0}, {"x_next": 4, "A": 16}, False),
        "long_inverse": Prototype("double", {"q": 2}, {"tau": 2}, False),
    }
    assert set(prototypes(HEADER, "model_long")) == {"inverse"}


CLOCK = """
#define _POSIX_C_SOURCE 199309L
#include <time.h>
#include "model.h"
enum { FIRST = 64 + 4 * 10 };
static long long time_ns;
static long count;
/* Takes the place of the library's: it goes on by 7 with each reading, by 100 with a warm call, and then by more. */
int clock_gettime(clockid_t id, struct timespec *time)
{
    (void)id;
    time_ns += 7;
    time->tv_sec = time_ns / 1000000000;
    time->tv_nsec = time_ns % 1000000000;
    return 0;
}
static void pass(void)
{
    time_ns += count < FIRST ? 100 : 1000 + count - FIRST;
    count += 1;
}
void model_step(const float x[2], float dt, float y[3])
{
    pass();
    y[0] = 1;
    y[1] = x[0] >= -2 && x[0] < 2 && x[1] >= -2 && x[1] < 2 && dt >= -2 && dt < 2 ? -2 : 10;
    y[2] = x[0] != x[1] && x[1] != dt ? 0.5f : 10;
}
float model_energy(const float x[2])
{
    pass();
    return x[0] < 2 ? 3 : 0;
}
float model_infinite(const float x[2])
{
    pass();
    return x[0] * 1e38f * 1e38f;
}
"""
DECLARED = """
void model_step(const float x[2], float dt, float y[3]);
float model_energy(const float x[2]);
float model_infinite(const float x[2]);
"""


@needs_compiler
def test_a_program_times_every_call_by_the_clock(tmp_path):
    (tmp_path / "model.h").write_text(DECLARED)
    (tmp_path / "model.c").write_text(CLOCK)
    functions = ("step", "energy", "infinite", "missing")
    built = programs(tmp_path, compiled(tmp_path, tmp_path), functions)
    found = {name: timed(each, repeats=3, calls=10, cold=200, mebibytes=1) for name, each in built.items()}
    assert list(found) == list(functions[:3])
    for times in found.values():
        assert times.timer == 7 and times.hot.tolist() == [100.0] * 3
        assert times.cold.tolist() == [1000.0 + k for k in range(200)]
    assert found["step"].sum == 64 * 3.5 and found["energy"].sum == 64 * 3 and np.isnan(found["infinite"].sum)
    turns = {(OURS, INVERSE): [found["step"], found["energy"]]}
    numbers = {row.quantity: row.value for row in exported_c.rows_of_calls("arm", Arm(1, "f32", 1), turns)}
    of_all = np.percentile(np.repeat(np.arange(1000.0, 1200), 2), [50, 99, 99.9])
    quantities = ("cold_p50_ns", "cold_p99_ns", "cold_p999_ns")
    assert numbers == {"hot_ns": 100, "hot_spread_ns": 0, **dict(zip(quantities, of_all, strict=True))}
    with pytest.raises(InputError, match=r"declares none of missing; export it again"):
        programs(tmp_path, tmp_path / "model.o", ["missing"])
    (tmp_path / "ends").write_text("#!/bin/sh\nexit 3\n")
    (tmp_path / "ends").chmod(0o700)
    with pytest.raises(InputError, match="ends ended with status 3"):
        timed(tmp_path / "ends", repeats=1, calls=1, cold=1, mebibytes=1)


def test_what_is_read_to_empty_caches_is_bounded():
    assert SMALLEST <= evicting() <= LARGEST


def times(nanoseconds, total=1.0):
    return Times(np.full(3, nanoseconds), np.full(5, 10 * nanoseconds), 20.0, total, "cc 1")


def test_rows_have_the_bounds_that_exports_must_reach():
    """Ratios are of each turn: the second turn of all is three times as slow."""
    fast, slow = [[times(each), times(3 * each)] for each in (100.0, 250.0)]
    turns = {(OURS, INVERSE): fast, (OURS, FORWARD): fast, (OURS, JACOBIAN): slow, (OTHERS, INVERSE): slow}
    bounds = {}
    for name, arm in ARMS.items():
        rows = exported_c.rows_of_calls(name, arm, turns)
        assert {row.value for row in rows if row.quantity in ("over_inverse", "speedup", "cold_speedup")} == {2.5}
        bounds |= {(row.case, row.quantity): (row.bound, row.passed) for row in rows if row.bound is not None}
    speedups = {"8x8-f64-d-2": (1.2, True), "64x64-f64-d-2": (2.0, True), "64x64-f32-d-2": (1.3, True)}
    expected = {}
    for arm in ("8x8-f64-d-2", "64x64-f64-d-2", "64x64-f32-d-2", "8x8-f64-d-7"):
        name = f"structured-delan-{arm}"
        expected[f"{name}/{JACOBIAN}", "over_inverse"] = (float(arm[-1]) + 3, True)
        expected[f"{name}/{INVERSE}", "relative_difference"] = (1e-4 if "f32" in arm else 1e-11, True)
        if arm in speedups:
            expected[f"{name}/{INVERSE}", "speedup"] = speedups[arm]
    assert bounds == expected
    (largest,) = exported_c.LARGEST
    (*_, making), (*_, other) = (exported_c.rows_of_making(name, (15.0, 6.0), "cc 1") for name in (largest, RIVALLED))
    assert (making.value, making.bound, making.passed) == (21.0, 20.0, False) and other.bound is None
    wrong = {(OURS, INVERSE): fast, (OTHERS, INVERSE): [times(1.0, float("nan"))] * 2}
    assert not exported_c.rows_of_calls(RIVALLED, ARMS[RIVALLED], wrong)[-1].passed


@pytest.mark.slow
@needs_compiler
def test_two_exports_take_turns_and_are_drawn(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(exported_c, "ARMS", {name: Arm(2, "f64", d) for d, name in enumerate(ARMS, start=1)})
    monkeypatch.setattr(exported_c, "LARGEST", {})
    monkeypatch.setattr(exported_c, "evicting", lambda: 1)
    monkeypatch.setattr(exported_c, "pinocchio_functions", rival)
    every = exported_c.functions_of_system
    monkeypatch.setattr(  # what else an export has takes long to compile
        exported_c, "functions_of_system", lambda *of, **at: {name: every(*of, **at)[name] for name in FUNCTIONS}
    )
    exported_c.export_all(tmp_path)
    found = exported_c.measure(True, tmp_path)
    values = {(row.case.removeprefix("structured-delan-"), row.quantity): row.value for row in found.rows}
    assert all(value > 0 for (_, quantity), value in values.items() if quantity.endswith(("_us", "_seconds")))
    for arm in ("8x8-f64-d-2", "8x8-f64-d-7"):
        assert values[f"{arm}/{INVERSE}", "relative_difference"] == 0
        assert {f"{arm}/{FORWARD}", f"{arm}/{FORWARD}/against"} < {case for case, _ in values}
    bounds = {row.quantity: row.bound for row in found.rows}
    assert bounds["over_rnea"] == bounds["over_aba"] == 1
    missing = tmp_path / exported_c.SMALLEST / "model.h"
    missing.unlink()
    line = refused(capsys, benchmark, "c", "--quick", "--out", str(tmp_path / "out"), "--against", str(tmp_path))
    assert f"lacks {exported_c.SMALLEST}/model.h" in line


def rival(tree):
    d = tree.degrees_of_freedom

    def echo(q, qd, x):
        assert q.shape == qd.shape == x.shape == (d,)

    return {name: pinocchio.Timed(echo, d, np.float64, f"{name} 1") for name in pinocchio.RIVALS.values()}


def test_another_export_is_refused_where_it_is_not_used(tmp_path, capsys):
    line = refused(capsys, benchmark, "scaling", "--out", str(tmp_path / "out"), "--against", str(tmp_path))
    assert "--against is for subject c; scaling does not use it" in line


def test_without_pinocchio_its_rows_are_left_out_with_a_line(monkeypatch, capsys):
    def missing(name):
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(pinocchio.importlib, "import_module", missing)
    assert pinocchio.pinocchio_functions(pinocchio.rival_arm(7)) == {}
    assert capsys.readouterr().out == "Pinocchio is missing, and so are its rows; pip install 'dln-jax[reference]'\n"


def test_the_rival_undoes_its_own_inverse_dynamics():
    pytest.importorskip("pinocchio", reason="the reference is Pinocchio, of the extra [reference]")
    functions = pinocchio.pinocchio_functions(pinocchio.rival_arm(7))
    q, qd, qdd = np.random.default_rng(0).normal(size=(3, 7))
    tau = functions["rnea"].function(q, qd, qdd).copy()
    np.testing.assert_allclose(functions["aba"].function(q, qd, tau), qdd, rtol=1e-9)
    assert np.abs(tau).min() > 0 and functions["aba"].title.startswith("aba of Pinocchio ")
