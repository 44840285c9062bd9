"""Jumps by 2 pi of angles that wrap are removed when a log is read, and nothing else is."""

import numpy as np
import pytest

from dln_jax.data import schema


def wrapped(values):
    return (values + np.pi) % (2 * np.pi) - np.pi


@pytest.fixture
def turning():
    """A joint that turns several times, one that swings about its stop at pi, and one that does neither."""
    t = np.arange(600) / 100
    q = np.stack([3 * t, np.pi + 0.3 * np.sin(4 * t), np.cos(t)], axis=1)
    return {"t": np.tile(t, 2), "q": np.vstack([q, -q]), "trajectory": np.repeat([0, 1], 600)}


def test_wrapped_angles_are_unwrapped_and_said(turning):
    data = schema.from_arrays({**turning, "q": wrapped(turning["q"])})
    rest = (data.q - turning["q"]).reshape(2, 600, 3)
    assert np.abs(rest - rest[:, :1]).max() < 1e-12  # up to whole turns of a trajectory
    assert np.abs(rest / (2 * np.pi) - np.round(rest / (2 * np.pi))).max() < 1e-12
    assert "column 1, 2 of q wrap by 2 pi" in data.remarks[0]
    assert np.abs(data.qd[:, 0]).max() < 3.1


def test_other_logs_stay_as_they_are(turning):
    assert schema.from_arrays(turning).remarks == ()
    slides = {**turning, "needs": np.array('{"joints": ["prismatic", "revolute", "revolute"]}')}
    data = schema.from_arrays({**slides, "q": wrapped(turning["q"])})
    assert "in column 2 of q" in data.remarks[0]
    assert np.array_equal(data.q[:, 0], wrapped(turning["q"][:, 0]))
    random = np.random.default_rng(0).uniform(-np.pi, np.pi, (1200, 3))
    assert np.array_equal(schema.from_arrays({**turning, "q": random}).q, random)
