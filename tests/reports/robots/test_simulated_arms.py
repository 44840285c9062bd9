"""Arms to learn from move within their limits, by motions whose rates are derivatives, with torques of the plant."""

import numpy as np

from dln_jax.mechanics.trees.inertia import pseudo_inertia
from scripts.reports.robots.simulated_arms import (
    lip_trajectories,
    panda,
    skew_arm,
    sliding_arm,
    sum_of_sines,
)


def test_motions_stay_within_limits_and_rates_are_derivatives():
    for arm in (panda(), panda(3), skew_arm(), sliding_arm()):
        t, q, qd, qdd = sum_of_sines(arm, seed=3, duration=10.0)
        reach = 0.5 * np.ptp(arm.limits, axis=1) / 2
        assert (np.abs(q - arm.limits.mean(axis=1)) < reach).all()
        assert (np.abs(qd) < arm.rates).all() and (np.abs(qdd) < arm.accelerations).all()
        for value, rate in ((q, qd), (qd, qdd)):
            estimate = (value[2:] - value[:-2]) / (t[2:] - t[:-2])[:, None]
            assert np.abs(estimate - rate[1:-1]).max() < 2e-3 * np.abs(rate).max()


def test_links_of_our_own_are_physically_consistent():
    for arm in (skew_arm(), sliding_arm()):
        assert all(np.linalg.eigvalsh(pseudo_inertia(theta)).min() > 0 for theta in arm.tree.inertias)


def test_trajectories_have_noise_and_friction():
    arm = panda(3)
    exact = lip_trajectories(arm, (0, 101), friction=True, noise=0.0, every=50)
    noisy = lip_trajectories(arm, (0, 101), friction=True, noise=0.1, every=50)
    assert exact.q.shape == (202, 3) and list(exact.label) == ["seed-0", "seed-101"]
    assert exact.needs is not None and exact.needs.friction
    np.testing.assert_array_equal(exact.q, noisy.q)
    assert 0.08 < np.std(noisy.tau - exact.tau) < 0.12
    frictionless = lip_trajectories(arm, (0, 101), noise=0.0, every=50)
    expected = arm.viscous * exact.qd + arm.coulomb * np.sign(exact.qd) + arm.offset
    np.testing.assert_allclose(exact.tau - frictionless.tau, expected, atol=1e-12)
