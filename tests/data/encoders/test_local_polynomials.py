"""Rates of noisy, unevenly sampled motions: better than differences, noise found, gaps respected."""

import numpy as np
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax.data import schema
from dln_jax.data.encoders.smoothing import smooth_locally

NOISE = np.array([1e-3, 1e-2])


def log(t, q):
    return schema.from_arrays({"t": t, "q": q, "trajectory": np.zeros(len(t))})


def test_noise_is_found_and_rates_are_better_than_differences_in_spite_of_a_gap():
    random = np.random.default_rng(0)
    t = np.delete(np.arange(600) + 0.1 * random.uniform(size=600), range(300, 310))[:, None] / 100
    q, qd = np.sin([3, 7] * t), [3, 7] * np.cos([3, 7] * t)
    data = log(t[:, 0], q + NOISE * random.normal(size=q.shape))
    smooth = smooth_locally(data)
    assert_allclose(smooth.noise, NOISE, rtol=0.15)
    assert len(smooth.rows) == len(t) and (np.std(smooth.data.q - q, axis=0) < 0.6 * NOISE).all()
    assert (np.std(smooth.data.qd - qd, axis=0) < 0.1 * np.std(data.qd - qd, axis=0)).all()


def test_polynomials_are_exact_and_short_segments_are_left_out():
    t = 0.05 * (np.arange(45) + 0.4 * np.random.default_rng(0).uniform(size=45))
    t[40:] += 1.0
    polynomial = np.polynomial.Polynomial([0.3, -1, 2, 0.5, -0.7])
    q, qd, qdd = (polynomial.deriv(k)(t)[:, None] for k in range(3))
    smooth = smooth_locally(log(t, q))
    assert_array_equal(smooth.rows, np.arange(40))
    assert_allclose([smooth.data.qd, smooth.data.qdd], [qd[:40], qdd[:40]], atol=1e-6)
    with one_line("no segment without a gap has 6 samples"):
        smooth_locally(log(t[40:], q[40:]))
