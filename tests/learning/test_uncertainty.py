"""Uncertainties equal closed forms, cover held-out noise, and tell near states from far ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from planar_arm import ARM as TREE

from dln_jax.data.schema import from_arrays
from dln_jax.learning import uncertainty
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.posterior import leading_directions, posterior, spectrum
from dln_jax.learning.uncertainty import calibration, effective_samples, estimate, scatter
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.errors import coverage
from dln_jax.models.model import linearised
from dln_jax.models.trees import make_rigid_tree
from dln_jax.models.uncertainty import out_of_distribution, predictive, scores

ARM = make_rigid_tree(TREE, friction=True, velocity_scale=0.1)
TRUTH = ARM.init(jax.random.key(0))._replace(
    viscous=jnp.array([0.2, 0.1]), coulomb=jnp.array([0.5, 0.3]), offset=jnp.array([0.1, 0.0])
)
NOISE = np.array([0.3, 0.05])
TORQUE = jax.jit(jax.vmap(dynamics(ARM.energies(TRUTH)).inverse_dynamics))


def drawn(seed, samples=200, reach=1.0, still=False, noise=NOISE):
    random = np.random.default_rng(seed)
    q, qd, qdd = reach * random.uniform(-1, 1, (3, samples, 2))
    if still:  # the second joint never moves
        q[:, 1], qd[:, 1], qdd[:, 1] = 0.4, 0.0, 0.0
    tau = np.asarray(TORQUE(q, qd, qdd)) + noise * random.normal(size=(samples, 2))
    return from_arrays(
        {"t": np.zeros(samples), "q": q, "qd": qd, "qdd": qdd, "tau": tau, "trajectory": np.arange(samples)}
    )


@pytest.fixture(scope="module")
def fitted():
    train, validation = drawn(0), drawn(1)
    parameters = fit_linear(ARM, train, negligible=1e-12).parameters
    return parameters, estimate(ARM, parameters, train, validation, ridge=0.0, negligible=1e-12)


def test_the_deviation_is_that_of_the_least_squares_fit(fitted):
    """The closed form of noise in the training torques, carried through the weighted pseudo-inverse."""
    parameters, found = fitted
    train, test = drawn(0), drawn(2, samples=5)
    rows = jax.jit(jax.vmap(lambda *state: linearised(ARM, parameters, *state)[0]))
    Phi = np.asarray(rows(train.q, train.qd, train.qdd)).reshape(400, -1)
    phi = np.asarray(rows(test.q, test.qd, test.qdd))
    weights = np.tile(1 / train.tau.std(axis=0), 200)
    solve = np.linalg.pinv(weights[:, None] * Phi, rcond=1e-10) * weights
    std = jax.jit(jax.vmap(predictive(ARM, parameters, found.uncertainty.factor)))(test.q, test.qd, test.qdd)
    closed = np.sqrt((phi @ solve) ** 2 @ np.tile(found.training_noise**2, 200))
    np.testing.assert_allclose(std, closed, rtol=1e-6)
    np.testing.assert_allclose(found.training_noise, NOISE, rtol=0.2)
    assert found.degrees_of_freedom.sum() == pytest.approx(np.linalg.matrix_rank(Phi, rtol=1e-10))


def test_bands_cover_what_they_promise(fitted):
    parameters, found = fitted
    factor, noise, inflation, _ = found.uncertainty
    std = jax.jit(jax.vmap(predictive(ARM, parameters, factor, noise, inflation)))
    motion = jax.jit(jax.vmap(dynamics(ARM.energies(parameters)).inverse_dynamics))
    test = drawn(10, samples=2000)
    state = test.q, test.qd, test.qdd
    shares = coverage(motion(*state) - test.tau, std(*state), levels=(0.5, 0.95))
    np.testing.assert_allclose(shares, [[0.5, 0.5], [0.95, 0.95]], atol=0.04)


def test_far_states_are_flagged_and_near_ones_are_not(fitted):
    parameters, found = fitted
    flag = jax.jit(jax.vmap(out_of_distribution(ARM, parameters, found.uncertainty)))
    near, far = drawn(5, reach=0.99), drawn(6, reach=30.0)
    assert np.mean(flag(near.q, near.qd, near.qdd)) <= 0.02
    away = (far.q, far.qd, far.qdd)
    error = jax.jit(jax.vmap(dynamics(ARM.energies(parameters)).inverse_dynamics))(*away) - TORQUE(*away)
    wrong = np.any(np.abs(error) > 3 * NOISE, axis=1)
    flagged = np.asarray(flag(*away))
    assert wrong.any() and flagged[wrong].all() and flagged.mean() >= 0.98
    assert flag(np.full((1, 2), np.nan), np.zeros((1, 2)), np.zeros((1, 2))).all()


def test_exact_linear_model_is_nowhere_outside():
    train, validation = drawn(0, noise=0.0), drawn(1, noise=0.0)
    parameters = fit_linear(ARM, train, negligible=1e-12).parameters
    found = estimate(ARM, parameters, train, validation, ridge=0.0, negligible=1e-12)
    away = drawn(2, reach=30.0)
    flag = jax.jit(jax.vmap(out_of_distribution(ARM, parameters, found.uncertainty)))
    assert not flag(away.q, away.qd, away.qdd).any()


def test_motions_that_differ_by_chance_alone_have_no_scatter():
    for motions, samples in [(4, 50), (8, 200), (400, 1)]:
        motion = np.repeat(np.arange(motions), samples)
        factors = [scatter(np.random.default_rng(seed).normal(size=motion.size), motion) for seed in range(20)]
        assert np.median(factors) == 1 and np.mean(factors) < 1.1


def test_few_motions_widen_bands_more_than_many_of_the_same_scatter():
    random = np.random.default_rng(0)
    four = np.sqrt([[0.3], [0.6], [1.1], [4.0]]) * random.normal(size=(4, 500))
    few = scatter(four.ravel(), np.repeat(np.arange(4), 500))
    many = scatter(np.tile(four.ravel(), 30), np.repeat(np.arange(120), 500))
    # Student's quantile is 3.18 of 4 motions and 1.98 of 120.
    assert few / many > (3.18 / 1.98) ** 2


def test_a_direction_that_data_never_showed_is_told_even_where_the_deviation_is_blind():
    train, validation = drawn(0, still=True), drawn(1, still=True)
    parameters = fit_linear(ARM, train, negligible=1e-12).parameters
    known = estimate(ARM, parameters, train, validation, ridge=0.0, negligible=1e-12).uncertainty
    q, qd, qdd = np.array([[0.5, 0.4], [0.3, 0.0], [-0.2, 0.0]])
    of_state = jax.jit(scores(ARM, parameters, known))
    assert max(map(float, of_state(q, qd, qdd))) < 1
    found = of_state(q, np.array([0.3, 1e-4]), qdd)
    assert found.distance < 1 and found.parameters < 1 < found.undetermined


def test_leading_directions_are_those_of_the_singular_value_decomposition(monkeypatch):
    random = np.random.default_rng(0)
    Phi = random.normal(size=(60, 1, 12)) * 10.0 ** -np.arange(12) @ np.linalg.qr(random.normal(size=(12, 12)))[0]
    unit = np.array([2.0])
    found = leading_directions(lambda: iter([(Phi[:40] / unit, 0), (Phi[40:] / unit, 0)]), 3)
    scaled = Phi[:, 0] / np.linalg.norm(Phi[:, 0] / unit, axis=0)
    _, _, right = np.linalg.svd(scaled, full_matrices=False)
    basis = found * np.linalg.norm(Phi[:, 0] / unit, axis=0)[:, None]
    np.testing.assert_allclose(np.linalg.norm(right[:3] @ basis, axis=1), 1.0, atol=1e-3)
    monkeypatch.setattr(uncertainty, "MOST_PARAMETERS", 10)
    monkeypatch.setattr(uncertainty, "DIRECTIONS", 3)
    assert estimate(ARM, TRUTH, drawn(0), drawn(1), ridge=0.1).uncertainty.factor.shape == (28, 3)


def test_the_covariance_is_that_of_bayes_where_all_joints_are_alike():
    random = np.random.default_rng(0)
    Phi, residual = random.normal(size=(50, 1, 6)), random.normal(size=(50, 1))
    found = spectrum(iter([(Phi[:20], residual[:20]), (Phi[20:], residual[20:])]))
    gram = Phi[:, 0].T @ Phi[:, 0]
    for ridge in (0.0, 0.1):
        of = posterior(found, ridge)
        factor = found.directions @ of.along / found.scale[:, None]
        inverse = np.linalg.inv(gram + ridge * np.diag(np.diag(gram)))
        np.testing.assert_allclose(factor @ factor.T, of.noise[0] ** 2 * inverse, rtol=1e-9)
        dof = np.trace(inverse @ gram)
        np.testing.assert_allclose(of.degrees_of_freedom, dof)
        np.testing.assert_allclose(of.noise[0] ** 2, np.sum(residual**2) / (50 - dof))


def test_calibration_finds_which_part_is_too_small():
    """Residuals as promised; larger altogether; larger by what is due to parameters."""
    for a, b, tolerance in [(1.0, 1.0, 1.0), (9.0, 9.0, 0.1), (1.0, 25.0, 0.3)]:
        random = np.random.default_rng(0)
        variance = random.uniform(0.0, 3.0, 2000)
        residual = np.sqrt(a * 0.5**2 + b * variance) * random.normal(size=2000)
        found = calibration(residual, 0.5, variance, 2000.0)
        np.testing.assert_allclose(np.log(found[0] + found[1]), np.log(a + b), atol=2 * tolerance)
        if a == b == 1.0:
            assert found[:2] == (1.0, 1.0)


def test_neighbours_that_are_alike_count_less():
    random = np.random.default_rng(0)
    white = random.normal(size=2000)
    slow = np.convolve(white, np.ones(20) / 20, mode="same")
    trajectory = np.repeat([0, 1], 1000)
    assert effective_samples(white, trajectory) > 1800
    assert 60 < effective_samples(slow, trajectory) < 300


def test_settings_out_of_range_are_refused():
    for keywords in ({"quantile": 0.0}, {"ridge": -1.0}, {"margin": 0.0}):
        with one_line(next(iter(keywords))):
            estimate(ARM, TRUTH, drawn(0), drawn(1), **keywords)
