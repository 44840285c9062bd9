"""Rates of noisy, unevenly sampled motions: better than differences, noise found, gaps respected."""

import numpy as np
import pytest

from dln_jax.data import schema
from dln_jax.data.encoders import smooth_locally
from dln_jax.types import InputError

NOISE = np.array([1e-3, 1e-2])


def motion():
    """Two coordinates, one trajectory with a gap, and their rates."""
    t = np.delete(np.arange(0, 6, 0.01) + 1e-3 * np.random.default_rng(1).uniform(size=600), range(300, 310))
    q = np.stack([np.sin(3 * t), np.cos(5 * t) + 0.3 * np.sin(9 * t)], axis=1)
    qd = np.stack([3 * np.cos(3 * t), -5 * np.sin(5 * t) + 2.7 * np.cos(9 * t)], axis=1)
    measured = q + NOISE * np.random.default_rng(0).normal(size=q.shape)
    return schema.from_arrays({"t": t, "q": measured, "trajectory": np.zeros(len(t))}), q, qd


def test_noise_is_found_and_rates_are_better_than_differences():
    data, q, qd = motion()
    smooth = smooth_locally(data)
    np.testing.assert_allclose(smooth.noise, NOISE, rtol=0.15)
    assert len(smooth.rows) == len(data.t)
    assert (np.std(smooth.data.q - q, axis=0) < 0.6 * NOISE).all()
    assert (np.std(smooth.data.qd - qd, axis=0) < 0.1 * np.std(data.qd - qd, axis=0)).all()


def test_polynomials_are_exact_and_short_segments_are_left_out():
    t = 0.05 * (np.arange(45) + 0.4 * np.random.default_rng(0).uniform(size=45))
    t[40:] += 1.0
    q = np.polynomial.Polynomial([0.3, -1, 2, 0.5, -0.7])
    smooth = smooth_locally(schema.from_arrays({"t": t, "q": q(t)[:, None], "trajectory": np.zeros(45)}))
    np.testing.assert_array_equal(smooth.rows, np.arange(40))
    np.testing.assert_allclose(smooth.data.qdd[:, 0], q.deriv(2)(t[:40]), atol=1e-6)
    np.testing.assert_allclose(smooth.data.qd[:, 0], q.deriv()(t[:40]), atol=1e-8)
    few = schema.from_arrays({"t": t[40:], "q": q(t[40:])[:, None], "trajectory": np.zeros(5)})
    with pytest.raises(InputError, match="no segment without a gap has 6 samples"):
        smooth_locally(few)
