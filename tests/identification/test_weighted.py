"""Weighted least squares: exact without noise, as uncertain as repetitions say, and deaf to spikes if asked."""

import numpy as np
import pytest

from dln_jax.identification.base import null_directions
from dln_jax.identification.equations import Equations, Regressor, about, compressed, residuals, squares, weighted
from dln_jax.identification.weighted import correlation_times, fit_robust, fit_weighted, residual_statistics
from dln_jax.types import InputError

NOISE = np.array([0.1, 2.0])
TRUE = np.array([1.0, -2.0, 0.5, 3.0, 0.7])


def design(seed, samples=300, *, dependent=False):
    """Phi [N, 2, 5] of very different columns; the last is the sum of the two first if it is dependent."""
    Phi = np.random.default_rng(seed).normal(size=(samples, 2, 5)) * [1.0, 1e3, 1e-3, 1.0, 2.0]
    if dependent:
        Phi[:, :, 4] = Phi[:, :, 0] + Phi[:, :, 1]
    return Phi


def regressor(Phi, tau, chunk=70):
    def passes():
        for first in range(0, len(tau), chunk):
            yield Phi[first : first + chunk], tau[first : first + chunk]

    return Regressor(passes, len(tau), 2, Phi.shape[2])


def test_triangles_have_all_that_data_say():
    random = np.random.default_rng(0)
    Phi, theta = design(0), random.normal(size=5)
    tau = random.normal(size=(300, 2))
    equations = compressed(regressor(Phi, tau))
    errors = tau - Phi @ theta
    np.testing.assert_allclose(squares(equations, theta), np.sum(errors**2, axis=0), rtol=1e-10)
    np.testing.assert_allclose(residuals(regressor(Phi, tau), theta), errors, atol=1e-12)
    np.testing.assert_allclose(squares(about(equations, theta), 0 * theta), np.sum(errors**2, axis=0), rtol=1e-10)
    whole = weighted(equations, NOISE) @ np.append(theta, -1.0)
    np.testing.assert_allclose(whole @ whole, np.sum((errors / NOISE) ** 2), rtol=1e-10)
    weights = random.uniform(0.1, 1, (300, 2))
    np.testing.assert_allclose(
        squares(compressed(regressor(Phi, tau), weights), theta), np.sum(weights * errors**2, axis=0), rtol=1e-10
    )


def test_standard_errors_are_those_of_repeated_experiments():
    """300 repetitions; the noise is recovered as well, and dependent parameters have no error of their own."""
    Phi = design(1, dependent=True)
    combinations = np.array([[0, 0, 1.0, 0, 0], [0, 0, 0, 1, 0], [1, 0, 0, 0, 1], [0, 1, 0, 0, 1]])
    fitted, errors, noises = [], [], []
    for seed in range(300):
        tau = Phi @ TRUE + NOISE * np.random.default_rng(seed).normal(size=(300, 2))
        fit = fit_weighted(compressed(regressor(Phi, tau)), np.zeros(5))
        fitted.append(combinations @ fit.theta)
        errors.append(fit.standard_errors(combinations))
        noises.append(fit.noise)
    np.testing.assert_allclose(np.mean(noises, axis=0), NOISE, rtol=0.02)
    np.testing.assert_allclose(np.std(fitted, axis=0), np.mean(errors, axis=0), rtol=0.12)
    np.testing.assert_allclose(
        np.mean(fitted, axis=0), combinations @ TRUE, atol=5 * np.mean(errors, axis=0).max() / 17
    )
    assert fit.rank == 4 and len(fit.without_effect) == 1
    np.testing.assert_array_equal(np.isinf(fit.standard_errors(np.eye(5))), [True, True, False, False, True])


def test_weights_beat_equal_ones():
    """A noisy joint counts less: errors of the other's accuracy."""
    Phi, ours, equal = design(2), [], []
    for seed in range(30):
        tau = Phi @ TRUE + NOISE * np.random.default_rng(seed).normal(size=(300, 2))
        equations = compressed(regressor(Phi, tau))
        ours.append(fit_weighted(equations, np.zeros(5)).theta - TRUE)
        equal.append(fit_weighted(equations, np.zeros(5), noise=np.ones(2)).theta - TRUE)
    assert (np.std(ours, axis=0) < 0.2 * np.std(equal, axis=0)).all()


def test_what_data_do_not_show_stays_as_it_was():
    Phi = design(3, dependent=True)
    Phi[:, :, 3] = 0
    known = TRUE + np.array([0.1, -0.1, 0.2, 5.0, 0.3])
    fit = fit_weighted(compressed(regressor(Phi, Phi @ TRUE)), known)
    assert fit.theta[3] == known[3]
    np.testing.assert_allclose(Phi @ fit.theta, Phi @ TRUE, atol=1e-8)
    # Along the direction without effect, in units of columns, nothing changed.
    np.testing.assert_allclose(
        fit.without_effect @ ((fit.theta - known) * fit.lengths), 0, atol=1e-6 * fit.lengths.max()
    )
    assert len(null_directions(Phi.reshape(-1, 5))) == len(fit.without_effect) == 2


def test_spikes_count_little():
    Phi, random = design(4), np.random.default_rng(0)
    clean = Phi @ TRUE + NOISE * random.normal(size=(300, 2))
    tau = clean + (random.random((300, 2)) < 0.05) * 100 * NOISE
    every = compressed(regressor(Phi, tau))
    fit, weights = fit_robust(regressor(Phi, tau), np.zeros(5))
    best, plain = fit_weighted(compressed(regressor(Phi, clean)), np.zeros(5)), fit_weighted(every, np.zeros(5))
    scale = best.standard_errors(np.eye(5))
    assert (abs(fit.theta - best.theta) < 1.5 * scale).all() and (abs(plain.theta - best.theta) > 2 * scale).any()
    np.testing.assert_allclose(fit.noise, NOISE, rtol=0.2)
    assert weights[abs(tau - clean) > 0].max() < 0.1 and np.median(weights) == 1.0


def test_statistics_of_residuals():
    random, samples = np.random.default_rng(0), 20_000
    white = random.normal(size=samples)
    following = np.zeros(samples)
    for k in range(1, samples):
        following[k] = 0.8 * following[k - 1] + random.normal()
    trajectory = np.repeat([0, 1], samples // 2)
    errors = np.stack([white, following], axis=1)
    statistics = residual_statistics(errors, trajectory, np.array([1.0, 1 / 0.6]))
    np.testing.assert_allclose(statistics.rms, [1.0, 1 / 0.6], rtol=0.05)
    np.testing.assert_allclose(statistics.correlation, [1.0, 9.0], rtol=0.25)  # (1 + 0.8) / (1 - 0.8)
    np.testing.assert_allclose(statistics.share_beyond_three, 0.0027, atol=2e-3)
    np.testing.assert_allclose(statistics.excess_kurtosis, 0, atol=0.3)
    np.testing.assert_array_equal(correlation_times(errors[:5], np.arange(5)), 1.0)


def test_residuals_that_follow_each_other_make_errors_larger():
    equations = compressed(regressor(design(5), NOISE * np.random.default_rng(0).normal(size=(300, 2))))
    one = fit_weighted(equations, np.zeros(5), noise=NOISE)
    nine = fit_weighted(equations, np.zeros(5), noise=NOISE, correlation=np.array([9.0, 9.0]))
    np.testing.assert_allclose(nine.standard_errors(np.eye(5)), 3 * one.standard_errors(np.eye(5)), rtol=1e-10)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"noise": np.array([1.0, 0.0])}, "noise is"),
        ({"rank_tolerance": 1.0}, "rank_tolerance is 1.0"),
    ],
)
def test_mistakes(settings, message):
    equations = compressed(regressor(design(0), design(0) @ TRUE))
    with pytest.raises(InputError, match=message):
        fit_weighted(equations, np.zeros(5), **settings)


def test_too_little_data():
    few = compressed(regressor(design(0, samples=2), np.ones((2, 2))))
    with pytest.raises(InputError, match="2 samples of 2 joints for 5 parameters"):
        fit_weighted(few, np.zeros(5))
    with pytest.raises(InputError, match="tau is zero"):
        fit_weighted(Equations(np.zeros((2, 6, 6)), 300), np.zeros(5))
