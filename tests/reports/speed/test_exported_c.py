"""Timing of exported C: its program by a clock of known pace, and rivals that compute the same numbers."""

import jax
import jax.numpy as jnp
import numpy as np
from compilers import needs_compiler
from numpy.testing import assert_allclose

from dln_jax import dynamics, export_c
from dln_jax.export.c.interface import Leaf, Signature
from dln_jax.mechanics.natural import lagrangian
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.scenes.scene import closed_form_forward_dynamics
from scripts.reports.speed import exported_c
from scripts.reports.speed.exported_c import STEP, compiled, evicting, programs, timed
from scripts.reports.speed.networks import by_full_hessian

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
void model_step(const float x[2], float dt, float y[3])
{
    time_ns += count < FIRST ? 100 : 1000 + count - FIRST;
    count += 1;
    y[0] = 1;
    y[1] = x[0] >= -2 && x[0] < 2 && x[1] >= -2 && x[1] < 2 && dt >= -2 && dt < 2 ? -2 : 10;
    y[2] = x[0] != x[1] && x[1] != dt ? 0.5f : 10;
}
"""


@needs_compiler
def test_program_times_every_call_by_the_clock(tmp_path, monkeypatch):
    arguments = Leaf("x", "real", (2,)), Leaf("dt", "real", ())
    signature = Signature(arguments, (Leaf("y", "real", (3,)),))
    monkeypatch.setattr(exported_c, "read_interface", lambda folder, name: ("f32", {"step": signature}, {}))
    (tmp_path / "model.h").write_text("void model_step(const float x[2], float dt, float y[3]);")
    (tmp_path / "model.c").write_text(CLOCK)
    built = programs(tmp_path, compiled(tmp_path, tmp_path), ["step"])
    found = timed(built["step"], repeats=3, calls=10, cold=200, mebibytes=1)
    assert found.hot.tolist() == [100.0] * 3 and found.cold.tolist() == [1000.0 + k for k in range(200)]
    assert found.sum == 64 * 3.5 and 8 <= evicting() <= 64


def test_textbook_rates_are_those_of_the_scene():
    x, u = np.random.default_rng(0).normal(size=4), np.array([0.3, -0.7])
    qdd = closed_form_forward_dynamics(two_link_arm(), *jnp.split(x, 2), jnp.asarray(u))
    assert_allclose(exported_c.textbook_rates()(jnp, x, u), [*x[2:], *qdd], rtol=1e-12)


@needs_compiler
def test_casadi_computes_the_same_numbers_by_its_own_derivatives(tmp_path):
    ours, rival = tmp_path / "ours", tmp_path / "casadi"
    kinds = exported_c.casadi_step(rival, shared=True)
    export_c({STEP: exported_c.our_steps()["closed-form"]}, ours, finite=True)
    effort = {"repeats": 1, "calls": 1, "cold": 1, "mebibytes": 1}
    sums = [timed(programs(at, compiled(at, at), [STEP], ours)[STEP], **effort).sum for at in (ours, rival)]
    assert_allclose(*sums, rtol=1e-12)
    assert kinds["functions"] == 24 and sum(kinds.values()) > 1000  # sine and cosine of three angles, four times


def test_full_hessian_gives_the_same_torques():
    energies = exported_c.random_network(2, 3, "f64")
    state = tuple(map(jnp.asarray, np.random.default_rng(0).standard_normal((3, 2))))
    ways = by_full_hessian(lagrangian(energies)), dynamics(energies).inverse_dynamics
    assert_allclose(*jax.jit(lambda *state: [way(*state) for way in ways])(*state), rtol=1e-11, atol=1e-12)
