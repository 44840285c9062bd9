"""Uncertainties equal closed forms and refits, cover held-out noise, and tell near states from far ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.data.schema import from_arrays
from dln_jax.data.splits import split
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.posterior import leading_directions, posterior, spectrum
from dln_jax.learning.uncertainty import DIRECTIONS, MOST_PARAMETERS, calibration, effective_samples, estimate, scatter
from dln_jax.mechanics.dynamics import InverseForward
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import dh_frames, inertial_parameters, serial
from dln_jax.metrics.coverage import coverage
from dln_jax.models.lagrangian import make_delan
from dln_jax.models.model import Model, linearised
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.models.trigonometric import make_trigonometric
from dln_jax.models.uncertainty import out_of_distribution, predictive, scores
from dln_jax.scenes.datasets.generators import uniform
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.types import InputError, Needs

FRAMES = dh_frames([[0, 0, 0.3, 0], [-np.pi / 2, 0, 0, 0]])
LINKS = [inertial_parameters(m, [0.05, -0.02, 0.1], np.diag([0.02, 0.03, 0.01])) for m in (3.0, 2.0)]
ARM = make_rigid_tree(serial(*FRAMES, LINKS, armature=[0.1, 0.2]), friction=True, velocity_scale=0.1)
TRUTH = ARM.init(jax.random.key(0))._replace(
    viscous=jnp.array([0.2, 0.1]), coulomb=jnp.array([0.5, 0.3]), offset=jnp.array([0.1, 0.0])
)
NOISE = np.array([0.3, 0.05])
TORQUE = jax.jit(jax.vmap(dynamics(ARM.energies(TRUTH)).inverse_dynamics))


def drawn(seed, samples=200, reach=1.0, still=False):
    random = np.random.default_rng(seed)
    q, qd, qdd = reach * random.uniform(-1, 1, (3, samples, 2))
    if still:  # the second joint never moves
        q[:, 1], qd[:, 1], qdd[:, 1] = 0.4, 0.0, 0.0
    tau = np.asarray(TORQUE(q, qd, qdd)) + NOISE * random.normal(size=(samples, 2))
    return from_arrays(
        {"t": np.zeros(samples), "q": q, "qd": qd, "qdd": qdd, "tau": tau, "trajectory": np.arange(samples)}
    )


@pytest.fixture(scope="module")
def fitted():
    train, validation = drawn(0), drawn(1)
    parameters = fit_linear(ARM, train, negligible=1e-12).parameters
    return parameters, estimate(ARM, parameters, train, validation, ridge=0.0, negligible=1e-12)


@pytest.mark.slow
def test_the_deviation_is_that_of_refits_to_other_noise(fitted):
    parameters, found = fitted
    train = drawn(0)
    rows = jax.jit(jax.vmap(lambda *state: linearised(ARM, parameters, *state)[0]))
    Phi = np.asarray(rows(train.q, train.qd, train.qdd)).reshape(400, -1)
    test = drawn(2, samples=5)
    phi = np.asarray(rows(test.q, test.qd, test.qdd))
    random, weights = np.random.default_rng(3), np.tile(1 / train.tau.std(axis=0), 200)
    noise = random.normal(size=(3000, 200, 2)) * found.training_noise
    solve = np.linalg.pinv(weights[:, None] * Phi, rcond=1e-10) * weights
    errors = np.einsum("nip,pm,rm->rni", phi, solve, noise.reshape(3000, -1))
    std = jax.jit(jax.vmap(predictive(ARM, parameters, found.uncertainty.factor)))(test.q, test.qd, test.qdd)
    # Of 3,000 refits a standard deviation is known to 1.3 %.
    np.testing.assert_allclose(std, errors.std(axis=0), rtol=0.06)
    closed = np.sqrt((phi @ solve) ** 2 @ np.tile(found.training_noise**2, 200))
    np.testing.assert_allclose(std, closed, rtol=1e-6)
    np.testing.assert_allclose(found.training_noise, NOISE, rtol=0.2)
    assert found.degrees_of_freedom.sum() == pytest.approx(np.linalg.matrix_rank(Phi, rtol=1e-10))


def test_bands_cover_what_they_promise(fitted):
    parameters, found = fitted
    factor, noise, inflation, _ = found.uncertainty
    std = jax.jit(jax.vmap(predictive(ARM, parameters, factor, noise, inflation)))
    motion = jax.jit(jax.vmap(dynamics(ARM.energies(parameters)).inverse_dynamics))
    shares = []
    for seed in range(10, 14):
        test = drawn(seed, samples=500)
        state = test.q, test.qd, test.qdd
        shares.append(coverage(motion(*state) - test.tau, std(*state), levels=(0.5, 0.95)).shares)
    np.testing.assert_allclose(np.mean(shares, axis=0), [[0.5, 0.5], [0.95, 0.95]], atol=0.04)


def test_far_states_are_flagged_and_near_ones_are_not(fitted):
    parameters, found = fitted
    flag = jax.jit(jax.vmap(out_of_distribution(ARM, parameters, found.uncertainty)))
    near, far = drawn(5, reach=0.99), drawn(6, reach=6.0)
    assert np.mean(flag(near.q, near.qd, near.qdd)) <= 0.02
    away = (far.q, far.qd, far.qdd)
    error = jax.jit(jax.vmap(dynamics(ARM.energies(parameters)).inverse_dynamics))(*away) - TORQUE(*away)
    wrong = np.any(np.abs(error) > 3 * NOISE, axis=1)
    flagged = np.asarray(flag(*away))
    assert wrong.any() and flagged[wrong].all() and flagged.mean() >= 0.98
    assert flag(np.full((1, 2), np.nan), np.zeros((1, 2)), np.zeros((1, 2))).all()


def test_exact_linear_model_is_nowhere_outside():
    scene = two_link_arm()
    model = make_trigonometric(scene.needs)
    sets = split(uniform(scene, samples=300, seed=0), validation_share=0.2)
    parameters = fit_linear(model, sets.train).parameters
    found = estimate(model, parameters, sets.train, sets.validation, ridge=0.0)
    random = np.random.default_rng(1)
    away = [random.uniform(-reach, reach, (200, 2)) for reach in (6.0, 30.0, 300.0)]
    flag = out_of_distribution(model, parameters, found.uncertainty)
    plants = dynamics(scene.energies), dynamics(model.energies(parameters))
    ask = jax.jit(jax.vmap(lambda *state: (*(plant.inverse_dynamics(*state) for plant in plants), flag(*state))))
    truth, predicted, flags = ask(*away)
    assert np.abs(predicted - truth).max() < 1e-8 * np.abs(truth).max()
    assert not flags.any()


@pytest.mark.parametrize(("motions", "samples"), [(4, 50), (8, 200), (400, 1)])
def test_motions_that_differ_by_chance_alone_have_no_scatter(motions, samples):
    factors = []
    for seed in range(20):
        relative = np.random.default_rng(seed).normal(size=motions * samples)
        factors.append(scatter(relative, np.repeat(np.arange(motions), samples)))
    assert np.median(factors) == 1 and np.mean(factors) < 1.1


def test_bands_with_scatter_hold_for_new_motions():
    """Each motion has an error of its own size, as what a model lacks has."""
    random, levels = np.random.default_rng(0), (0.9,)
    sizes = np.sqrt(random.lognormal(0.0, 0.7, (60, 1)))
    errors = sizes * random.normal(size=(60, 200))
    motion = np.repeat(np.arange(10), 200)
    plain, scattered = [], []
    for fitted in range(0, 50, 10):
        known, new = errors[fitted : fitted + 10].ravel(), errors[50:]
        std = np.sqrt(np.mean(known**2))
        raised = std * np.sqrt(scatter(known / std, motion))
        for shares, band in ((plain, std), (scattered, raised)):
            shares.append([coverage(x[:, None], np.full((200, 1), band), levels=levels).shares[0, 0] for x in new])
    assert np.min(scattered) > np.min(plain) + 0.03
    assert np.mean(np.array(scattered) >= 0.9) > 0.75 > np.mean(np.array(plain) >= 0.9)


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
    still = [np.array([0.5, 0.4]), np.array([0.3, 0.0]), np.array([-0.2, 0.0])]
    moving = [still[0], np.array([0.3, 1e-4]), still[2]]
    of_state = jax.jit(scores(ARM, parameters, known))
    assert max(map(float, of_state(*still))) < 1
    found = of_state(*moving)
    assert found.distance < 1 and found.parameters < 1 < found.undetermined


@pytest.mark.slow
def test_a_network_is_uncertain_where_it_has_seen_nothing():
    needs = Needs(joints=("revolute", "revolute"))
    model = make_delan(needs, width=4, depth=1, dtype=jnp.float64)
    truth = jax.jit(model.init)(jax.random.key(1))
    torque = jax.jit(jax.vmap(dynamics(model.energies(truth)).inverse_dynamics))
    sets = []
    for seed in range(3):
        data = drawn(seed, samples=150, reach=0.7)
        tau = np.asarray(torque(data.q, data.qd, data.qdd))
        tau = tau + 0.02 * np.random.default_rng(seed).normal(size=tau.shape)
        sets.append(data._replace(tau=tau))
    found = estimate(model, truth, *sets[:2])
    assert found.uncertainty.domain.undetermined.shape[1] == 0
    factor, noise, inflation, _ = found.uncertainty
    std = jax.jit(jax.vmap(predictive(model, truth, factor, noise, inflation)))
    near, far = sets[2], drawn(7, samples=50, reach=3.0)
    predicted = torque(near.q, near.qd, near.qdd)
    assert 0.9 < coverage(predicted - near.tau, std(near.q, near.qd, near.qdd), levels=(0.95,)).shares.mean() < 0.99
    assert np.median(std(far.q, far.qd, far.qdd)) > 2 * np.median(std(near.q, near.qd, near.qdd))
    flag = jax.jit(jax.vmap(out_of_distribution(model, truth, found.uncertainty)))
    assert np.mean(flag(far.q, far.qd, far.qdd)) > 0.95 and np.mean(flag(near.q, near.qd, near.qdd)) < 0.05


@pytest.mark.slow
def test_leading_directions_are_those_of_the_singular_value_decomposition():
    random = np.random.default_rng(0)
    Phi = random.normal(size=(60, 1, 12)) * 10.0 ** -np.arange(12) @ np.linalg.qr(random.normal(size=(12, 12)))[0]
    unit = np.array([2.0])
    found = leading_directions(lambda: iter([(Phi[:40], 0), (Phi[40:], 0)]), unit, 3)
    scaled = Phi[:, 0] / np.linalg.norm(Phi[:, 0] / unit, axis=0)
    _, _, right = np.linalg.svd(scaled, full_matrices=False)
    basis = found * np.linalg.norm(Phi[:, 0] / unit, axis=0)[:, None]
    np.testing.assert_allclose(np.linalg.norm(right[:3] @ basis, axis=1), 1.0, atol=1e-3)
    network = make_delan(Needs(joints=("revolute", "revolute")), width=32, depth=2, dtype=jnp.float64)
    parameters = jax.jit(network.init)(jax.random.key(0))
    factor = estimate(network, parameters, drawn(0), drawn(1)).uncertainty.factor
    size = sum(leaf.size for leaf in jax.tree.leaves(parameters))
    assert size > MOST_PARAMETERS and factor.shape == (size, DIRECTIONS)


@pytest.mark.parametrize("ridge", [0.0, 0.1])
def test_the_covariance_is_that_of_bayes_where_all_joints_are_alike(ridge):
    random = np.random.default_rng(0)
    Phi, residual = random.normal(size=(50, 1, 6)), random.normal(size=(50, 1))
    found = spectrum(iter([(Phi[:20], residual[:20]), (Phi[20:], residual[20:])]), np.array([1.0]))
    of = posterior(found, ridge)
    factor = found.directions @ of.along / found.scale[:, None]
    gram = Phi[:, 0].T @ Phi[:, 0]
    inverse = np.linalg.inv(gram + ridge * np.diag(np.diag(gram)))
    np.testing.assert_allclose(factor @ factor.T, of.noise[0] ** 2 * inverse, rtol=1e-9)
    dof = np.trace(inverse @ gram)
    np.testing.assert_allclose(of.degrees_of_freedom, dof)
    np.testing.assert_allclose(of.noise[0] ** 2, np.sum(residual**2) / (50 - dof))


CALIBRATIONS = {  # residuals as a function of noise and of variance -> what (a, b) ought to be
    "as promised": (1.0, 1.0, 1.0),
    "all is larger": (9.0, 9.0, 0.1),
    "the parameters' part is larger": (1.0, 25.0, 0.3),
}


@pytest.mark.parametrize("a, b, tolerance", CALIBRATIONS.values(), ids=CALIBRATIONS)
def test_calibration_finds_which_part_is_too_small(a, b, tolerance):
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


@pytest.mark.parametrize(
    "keywords, message", [({"quantile": 0.0}, "quantile"), ({"ridge": -1.0}, "ridge"), ({"margin": 0.0}, "margin")]
)
def test_settings_out_of_range_are_refused(keywords, message):
    with pytest.raises(InputError, match=message) as caught:
        estimate(ARM, TRUTH, drawn(0), drawn(1), **keywords)
    assert "\n" not in str(caught.value)


def test_any_model_of_torques_will_do():
    def energies(theta):
        return InverseForward(lambda q, qd, qdd: theta * q, lambda q, qd, tau: tau)

    model = Model(lambda key: jnp.ones(()), energies)
    data = drawn(0)
    known = estimate(model, jnp.ones(()), data._replace(tau=data.q + 0.1), data, ridge=0.0).uncertainty
    assert known.factor.shape == (1, 1)
