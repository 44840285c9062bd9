"""The board's score is the published one."""

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control.closed_loop import ClosedLoopRun
from scripts.reports.control import swing_ups

NAMES = tuple(swing_ups.SIZES)


def test_score_of_printed_criteria():
    # "History SAC" of the board, whose criteria are printed with three digits; its score is 0.655.
    printed = dict(zip(NAMES, (1.00, 8.08, 1.80, 0.010, 88.5), strict=True))
    assert swing_ups.score(printed) == pytest.approx(0.655, abs=0.003)
    assert swing_ups.score({**printed, "time": np.inf}) == 0 == swing_ups.score({**printed, "energy": np.nan})


def test_criteria_of_a_known_motion():
    t = np.arange(5001) / swing_ups.RATE
    q = np.stack([np.minimum(np.pi * t, np.pi), np.zeros_like(t)], axis=1)
    qd = np.stack([np.where(t < 1, np.pi, 0.0), np.zeros_like(t)], axis=1)
    u = np.where(t[:-1] < 1, 2.0, 0.0)[:, None]
    found = swing_ups.criteria("shoulder", ClosedLoopRun(*map(jnp.asarray, (t, np.hstack([q, qd]), u, q))))
    # The stretched tip is at 0.9 of its length from the angle arccos(-0.9) on.
    expected = np.arccos(-0.9) / np.pi, 2 * np.pi, 4.0, 2 / np.sqrt(4999), np.pi**2
    np.testing.assert_allclose([found[name] for name in NAMES], expected, rtol=6e-3)
