"""Rates of noisy motions: better than differences, noise found, gaps respected."""

import numpy as np
import pytest

from dln_jax.data import schema
from dln_jax.data.local_polynomials import smooth_locally
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
    assert len(smooth.rows) == len(data.t) and smooth.points[0] > smooth.points[1]
    assert (np.std(smooth.data.q - q, axis=0) < 0.6 * NOISE).all()
    assert (np.std(smooth.data.qd - qd, axis=0) < 0.1 * np.std(data.qd - qd, axis=0)).all()


def test_polynomials_are_exact():
    t = np.sort(np.random.default_rng(0).uniform(0, 2, 40))
    q = np.polynomial.Polynomial([0.3, -1, 2, 0.5, -0.7])
    smooth = smooth_locally(schema.from_arrays({"t": t, "q": q(t)[:, None], "trajectory": np.zeros(40)}), gap=100.0)
    np.testing.assert_allclose(smooth.data.qdd[:, 0], q.deriv(2)(t), atol=1e-6)
    np.testing.assert_allclose(smooth.data.qd[:, 0], q.deriv()(t), atol=1e-8)


def test_mistakes_are_named():
    data = motion()[0]
    refused = [
        (lambda: smooth_locally(data, degree=1), "degree is 1"),
        (lambda: smooth_locally(data, points=5), "points is 5"),
        (lambda: smooth_locally(data, points=500), "has 500 samples"),
    ]
    for call, message in refused:
        with pytest.raises(InputError, match=message):
            call()
