"""Weighted least squares: exact without noise, as uncertain as a regression by hand, and deaf to spikes if asked.

And a motor that turns with two joints is found in what a fit leaves unexplained.
"""

import numpy as np

from dln_jax.identification.equations import Equations, compress, null_directions, squares, whiten
from dln_jax.identification.rigid_tree import shared_motor
from dln_jax.identification.weighted import correlation_times, fit_robust, fit_weighted
from tests.calls import one_line

NOISE = np.array([0.1, 2.0])
TRUE = np.array([1.0, -2.0, 0.5, 3.0, 0.7])
ZERO = np.zeros(5)


def design(seed, samples=300):
    """Phi [N, 2, 5] of very different columns."""
    return np.random.default_rng(seed).normal(size=(samples, 2, 5)) * [1.0, 1e3, 1e-3, 1.0, 2.0]


def regressor(Phi, tau, chunk=70):
    def passes():
        for first in range(0, len(tau), chunk):
            yield Phi[first : first + chunk], tau[first : first + chunk]

    return passes


def test_triangles_have_all_that_data_say():
    random, Phi = np.random.default_rng(0), design(0)
    theta, tau, weights = random.normal(size=5), random.normal(size=(300, 2)), random.uniform(0.1, 1, (300, 2))
    equations = compress(regressor(Phi, tau), weights)
    expected = np.sum(weights * (tau - Phi @ theta) ** 2, axis=0)
    np.testing.assert_allclose(squares(equations, theta), expected, rtol=1e-10)
    whole = whiten(equations, NOISE) @ np.append(theta, -1.0)
    np.testing.assert_allclose(whole @ whole, np.sum(expected / NOISE**2), rtol=1e-10)


def test_estimates_and_their_errors_are_those_of_two_regressions_by_hand():
    """A body that carries a second one of two parts: tau_1 = a (m_1 + m_2 + m_3) and tau_2 = b (m_2 + m_3)."""
    random = np.random.default_rng(1)
    a, b = acceleration = random.normal(size=(2, 300))
    Phi = np.stack([np.multiply.outer(a, [1, 1, 1]), np.multiply.outer(b, [0, 1, 1])], axis=1)
    tau = Phi @ [1.0, 0.3, 0.2] + NOISE * random.normal(size=(300, 2))
    equations = compress(regressor(Phi, tau))
    fit = fit_weighted(equations, np.zeros(3))
    lengths = np.sum(acceleration**2, axis=1)
    every, carried = masses = np.sum(acceleration.T * tau, axis=0) / lengths
    noise = np.sqrt(np.sum((tau - acceleration.T * masses) ** 2, axis=0) / 299)
    np.testing.assert_allclose(fit.noise, noise, rtol=1e-6)
    combinations = np.array([[1.0, 1.0, 1.0], [0.0, 1.0, 1.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(combinations @ fit.theta, [every, carried, every - carried], rtol=1e-9)
    errors = noise / np.sqrt(lengths)
    expected = np.append(errors, np.hypot(*errors))
    np.testing.assert_allclose(fit.standard_errors(combinations), expected, rtol=1e-6)
    # Nine consecutive correlated residuals count as one.
    correlated = fit_weighted(equations, np.zeros(3), correlation=np.full(2, 9.0))
    np.testing.assert_allclose(correlated.standard_errors(combinations), 3 * expected, rtol=1e-6)
    assert fit.rank == 2 and np.isinf(fit.standard_errors(np.eye(3))).tolist() == [False, True, True]


def test_what_data_do_not_show_stays_as_it_was():
    Phi = design(3)
    Phi[:, :, 4] = Phi[:, :, 0] + Phi[:, :, 1]
    Phi[:, :, 3] = 0
    known = TRUE + np.array([0.1, -0.1, 0.2, 5.0, 0.3])
    fit = fit_weighted(compress(regressor(Phi, Phi @ TRUE)), known)
    assert fit.theta[3] == known[3]
    np.testing.assert_allclose(Phi @ fit.theta, Phi @ TRUE, atol=1e-8)
    # Along the direction without effect, in units of columns, nothing changed.
    changes = fit.without_effect @ ((fit.theta - known) * fit.lengths)
    np.testing.assert_allclose(changes, 0, atol=1e-6 * fit.lengths.max())
    assert len(null_directions(Phi.reshape(-1, 5))) == len(fit.without_effect) == 2


def test_spikes_count_little():
    Phi, random = design(4), np.random.default_rng(0)
    spikes = (random.random((300, 2)) < 0.05) * 100 * NOISE
    tau = Phi @ TRUE + NOISE * random.normal(size=(300, 2))
    best, plain = (fit_weighted(compress(regressor(Phi, each)), ZERO) for each in (tau, tau + spikes))
    fit, weights = fit_robust(regressor(Phi, tau + spikes), ZERO)
    scale = best.standard_errors(np.eye(5))
    assert (abs(fit.theta - best.theta) < 1.5 * scale).all() and (abs(plain.theta - best.theta) > 2 * scale).any()
    np.testing.assert_allclose(fit.noise, NOISE, rtol=0.2)
    assert weights[spikes > 0].max() < 0.1 and np.median(weights) == 1.0


def test_correlation_times_of_residuals():
    errors = np.random.default_rng(0).normal(size=(20_000, 2))
    for k in range(1, 20_000):
        errors[k, 1] += 0.8 * errors[k - 1, 1]
    found = correlation_times(errors, np.repeat([0, 1], 10_000))
    np.testing.assert_allclose(found, [1.0, 9.0], rtol=0.25)  # (1 + 0.8) / (1 - 0.8)
    np.testing.assert_array_equal(correlation_times(errors[:5], np.arange(5)), 1.0)


def test_mistakes_are_named():
    equations = compress(regressor(design(0), np.ones((300, 2))))
    few = compress(regressor(design(0, samples=2), np.ones((2, 2))))
    for given, settings, message in (
        (equations, {"noise": np.array([1.0, 0.0])}, "noise is"),
        (few, {}, "2 samples of 2 joints are too few for 5 parameters"),
        (Equations(np.zeros((2, 6, 6)), 300), {}, "tau is zero"),
    ):
        with one_line(message):
            fit_weighted(given, ZERO, **settings)


def rates(random):
    t = np.linspace(0, 20, 2000)
    frequencies, phases = random.uniform(0.2, 1.5, size=(2, 4, 4))
    return np.cos(2 * np.pi * np.multiply.outer(t, frequencies) + 6 * phases).sum(axis=1)


def friction(rate, viscous, coulomb):
    return viscous * rate + coulomb * np.tanh(rate / 0.05)


def test_a_motor_of_two_joints_is_found():
    for joint, other, ratio in ((3, 2, -0.5), (2, 1, 1.5)):
        random = np.random.default_rng(joint)
        qd = rates(random)
        left = 0.3 * random.normal(size=qd.shape)
        torque = friction(qd[:, joint] + ratio * qd[:, other], 0.4, 1.5)
        left[:, joint] += torque - friction(qd[:, joint], 0.3, 1.0)  # a fit explains part by the joints' own rates
        left[:, other] += ratio * torque - friction(qd[:, other], 0.2, 0.5)
        motor = shared_motor(left, qd)
        assert motor is not None and motor[:3] == (joint, other, ratio) and 0.3 <= motor[3] <= 1


def test_no_motor_is_found_in_friction_of_single_joints_or_in_noise():
    assert shared_motor(np.ones((100, 1)), np.ones((100, 1))) is None
    for seed in range(2):
        random = np.random.default_rng(seed)
        qd = rates(random)
        noise = random.normal(size=qd.shape)
        stribeck = noise * 0.2 + np.tanh(qd / 0.02) * np.exp(-((qd / 0.3) ** 2))
        for left in (noise, stribeck, np.cumsum(noise, axis=0) / 30, 0 * noise):
            assert shared_motor(left, qd) is None
