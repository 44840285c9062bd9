"""The board's score is the published one of printed criteria, and what is measured of a run is what its motion says."""

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import ClosedLoopRun
from dln_jax.mechanics.equations import dynamics
from scripts.reports.control import board
from scripts.reports.control.board import Criteria, criteria, plant, play, score
from scripts.reports.control.energy_laws import Law, runs_by_energy
from scripts.reports.control.planned import Weights, follower, planned


def test_the_score_is_that_of_printed_criteria():
    # "History SAC" of the board, whose criteria are printed with three digits; its score is 0.655.
    assert score(Criteria(1.00, 8.08, 1.80, 0.010, 88.5)) == pytest.approx(0.655, abs=0.003)
    assert score(Criteria(np.inf, 1.0, 1.0, 0.01, 1.0)) == 0 == score(Criteria(1.0, np.nan, 1.0, 0.01, 1.0))


def test_criteria_of_a_motion_that_is_known():
    t = np.arange(5001) / board.RATE
    q = np.stack([np.minimum(np.pi * t, np.pi), np.zeros_like(t)], axis=1)
    qd = np.stack([np.where(t < 1, np.pi, 0.0), np.zeros_like(t)], axis=1)
    u = np.where(t[:-1] < 1, 2.0, 0.0)[:, None]
    found = criteria("shoulder", ClosedLoopRun(*map(jnp.asarray, (t, np.hstack([q, qd]), u, q))))
    # The stretched tip is at 0.9 of its length from the angle arccos(-0.9) on.
    assert found.time == pytest.approx(np.arccos(-0.9) / np.pi, abs=2 / board.RATE)
    assert found.energy == pytest.approx(2 * np.pi, rel=1e-12)
    assert found.torque_cost == pytest.approx(4.0) and found.velocity_cost == pytest.approx(np.pi**2)
    assert found.smoothness == pytest.approx(2 / np.sqrt(4999), rel=1e-3)


@pytest.mark.slow
def test_a_plan_is_followed_up_and_held():
    weights = Weights()
    plan = planned("shoulder", weights, jnp.asarray(10.0 * np.random.default_rng(0).normal(size=(60, 1))))
    found = criteria("shoulder", play("shoulder", follower("shoulder", weights, plan)))
    assert found.time < 1.2 and score(found) > 0.6
    # What goes in is at least what the goal has more.
    system = dynamics(plant("shoulder")[0].energies)
    rise = float(system.energy(board.GOAL[:2], np.zeros(2)) - system.energy(np.zeros(2), np.zeros(2)))
    assert found.energy > rise


@pytest.mark.slow
def test_a_law_by_energy_comes_up():
    numbers = Law(jnp.array([2.02, 8.59, 13.5]), jnp.array(2.08), jnp.array(0.476), jnp.array(1.93))
    assert score(criteria("elbow", runs_by_energy("elbow")(numbers))) > 0.4
