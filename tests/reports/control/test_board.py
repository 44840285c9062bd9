"""The board's score is the published one, and its disturbances are those of its table."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import ClosedLoopRun, Controller, stateless
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import Links, two_link_pendulum
from scripts.reports.control import board
from scripts.reports.control.disturbed_board import (
    NOMINAL,
    Disturbance,
    disturbances,
    field_for,
    last_state,
    numbers_of,
)

NAMES = tuple(board.SIZES)
HEAVY = Links()._replace(masses=(Links().masses[0], 1.2 * Links().masses[1]))


def test_score_of_printed_criteria():
    # "History SAC" of the board, whose criteria are printed with three digits; its score is 0.655.
    printed = dict(zip(NAMES, (1.00, 8.08, 1.80, 0.010, 88.5), strict=True))
    assert board.score(printed) == pytest.approx(0.655, abs=0.003)
    assert board.score({**printed, "time": np.inf}) == 0 == board.score({**printed, "energy": np.nan})


def test_criteria_of_a_known_motion():
    t = np.arange(5001) / board.RATE
    q = np.stack([np.minimum(np.pi * t, np.pi), np.zeros_like(t)], axis=1)
    qd = np.stack([np.where(t < 1, np.pi, 0.0), np.zeros_like(t)], axis=1)
    u = np.where(t[:-1] < 1, 2.0, 0.0)[:, None]
    found = board.criteria("shoulder", ClosedLoopRun(*map(jnp.asarray, (t, np.hstack([q, qd]), u, q))))
    # The stretched tip is at 0.9 of its length from the angle arccos(-0.9) on.
    expected = np.arccos(-0.9) / np.pi, 2 * np.pi, 4.0, 2 / np.sqrt(4999), np.pi**2
    np.testing.assert_allclose([found[name] for name in NAMES], expected, rtol=6e-3)


@pytest.mark.parametrize("motor", ["elbow", "shoulder"])
def test_nine_numbers_are_the_plant(motor):
    x, u, B = jnp.array([0.4, 1.1, -2.0, 3.0]), jnp.array([1.5]), board.plant(motor)[1]
    viscous, dry, rotor = np.array([0.05, -0.03]), np.array([0.1, 0.2]), 8e-5
    p = numbers_of(HEAVY) + np.array([0, 0, 0, 0, *viscous, *dry, rotor])
    q, qd = x[:2], x[2:]
    qdd = field_for(p, B)(x, u)[2:]
    free = dynamics(two_link_pendulum(motor, links=HEAVY).closed_form).inverse_dynamics(q, qd, qdd)
    more = viscous * qd + dry * np.arctan(100 * qd) + rotor * np.array([[37.0, -6.0], [-6.0, 36.0]]) @ qdd
    np.testing.assert_allclose(free + more, B @ u, atol=1e-9)


def test_loop_is_the_boards_and_measurements_are_late(monkeypatch):
    monkeypatch.setattr(board, "SECONDS", 0.1)
    law = stateless(lambda y: -3.0 * jnp.stack([y[1] - 0.4]) - 0.2 * y[3:])
    run = jax.jit(lambda: board.closed_loop("elbow", law))()
    key = jax.random.key(0)
    late = jax.jit(jax.vmap(lambda delay: last_state("elbow", law, Disturbance(NOMINAL, delay=delay), key, 0.1)))
    ends = late(jnp.arange(3))
    np.testing.assert_allclose(ends[0], run.x[-1], atol=1e-9)
    assert np.abs(np.diff(ends, axis=0)).max(axis=1).min() > 1e-6


def test_table_is_the_boards():
    table = disturbances()
    assert [len(listed) for listed in table.values()] == [210, 210, 210, 21, 21, 50]
    # The middle factors, and no friction and no rotor, are nominal.
    assert sum(np.allclose(one.numbers, NOMINAL, rtol=1e-12) for one in table["model"]) == 10
    for one in table["pushes"]:
        times = np.sort(one.times.ravel())
        assert times[0] >= 1 and (np.diff(times) >= 1).all() and times[-1] <= 9
        assert (np.abs(one.pushes) >= 0.5).all() and (np.abs(one.pushes) <= 5).all()


@pytest.mark.parametrize(("motor", "driven"), [("shoulder", 0), ("elbow", 1)])
def test_only_pushes_on_the_driven_joint_move_the_arm(motor, driven):
    idle, shape = stateless(lambda y: jnp.zeros(1)), {"times": np.full((2, 1), 0.1), "widths": np.full((2, 1), 0.02)}
    run = jax.jit(
        lambda push: last_state(motor, idle, Disturbance(NOMINAL, **shape, pushes=push), jax.random.key(0), 0.2)
    )
    ends = [np.asarray(run(push)) for push in 3.0 * np.eye(2)[:, :, None]]
    assert np.abs(ends[driven]).max() > 0.1
    np.testing.assert_array_equal(ends[1 - driven], 0.0)


def test_failing_controller_has_no_last_state():
    failing = Controller(jnp.asarray(0), lambda n, t, y: (n + 1, jnp.where(n == 3, jnp.nan, 0.0)[None]))
    run = jax.jit(lambda: last_state("elbow", failing, Disturbance(NOMINAL), jax.random.key(0), 0.1))
    assert np.isnan(run()).any()
