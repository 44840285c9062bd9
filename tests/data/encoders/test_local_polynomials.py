"""Rates of noisy, unevenly sampled motions: better than differences, noise found, gaps respected."""

import numpy as np

from dln_jax.data import schema
from dln_jax.data.encoders import smooth_locally
from tests.calls import one_line
from tests.motions import sums_of_sines

NOISE = np.array([1e-3, 1e-2])


def log(t, q):
    return schema.from_arrays({"t": t, "q": q, "trajectory": np.zeros(len(t))})


def test_noise_is_found_and_rates_are_better_than_differences_in_spite_of_a_gap():
    random = np.random.default_rng(0)
    t = np.delete(np.arange(0, 6, 0.01) + 1e-3 * random.uniform(size=600), range(300, 310))
    q, qd, _ = sums_of_sines(t, np.array([[1, 0], [1, 0.3]]), np.array([[3, 0], [5, 9]]), np.array([[0], [np.pi / 2]]))
    data = log(t, q + NOISE * random.normal(size=q.shape))
    smooth = smooth_locally(data)
    np.testing.assert_allclose(smooth.noise, NOISE, rtol=0.15)
    assert len(smooth.rows) == len(data.t)
    assert (np.std(smooth.data.q - q, axis=0) < 0.6 * NOISE).all()
    assert (np.std(smooth.data.qd - qd, axis=0) < 0.1 * np.std(data.qd - qd, axis=0)).all()


def test_polynomials_are_exact_and_short_segments_are_left_out():
    t = 0.05 * (np.arange(45) + 0.4 * np.random.default_rng(0).uniform(size=45))
    t[40:] += 1.0
    q = np.polynomial.Polynomial([0.3, -1, 2, 0.5, -0.7])
    smooth = smooth_locally(log(t, q(t)[:, None]))
    np.testing.assert_array_equal(smooth.rows, np.arange(40))
    np.testing.assert_allclose(smooth.data.qdd[:, 0], q.deriv(2)(t[:40]), atol=1e-6)
    np.testing.assert_allclose(smooth.data.qd[:, 0], q.deriv()(t[:40]), atol=1e-8)
    with one_line("no segment without a gap has 6 samples"):
        smooth_locally(log(t[40:], q(t[40:])[:, None]))
