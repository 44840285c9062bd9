"""Kernel energies fitted to torques: exact where the basis is, friction beside them, the likelihood's slope."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.data.splits import select
from dln_jax.learning.kernel import fit_kernel
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.marginal_likelihood import TorqueEquations, Unknowns, likelihood, start_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.torque_covariance import States
from dln_jax.scenes.datasets.generators import uniform
from dln_jax.scenes.pendulums import pendulum, two_link_arm
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import CATALOGUE

COEFFICIENTS = {"viscous": [0.3, 0.1], "coulomb": [0.2, 0.4], "offset": [0.1, -0.05]}


@pytest.fixture(scope="module")
def arm():
    """States of a two-link arm, with friction in its joints: to fit, and to judge by."""
    scene = two_link_arm()
    data = uniform(scene, samples=140, rate_bound=3.0, acceleration_bound=5.0)
    needs = scene.needs._replace(joint_friction=("viscous", "coulomb", "offset"), velocity_scale=0.1)
    b, c, o = COEFFICIENTS.values()
    tau = data.tau + b * data.qd + c * np.tanh(data.qd / 0.1) + o
    data = data._replace(tau=tau, needs=needs)
    return select(data, np.arange(60)), select(data, np.arange(60, 140))


@pytest.mark.slow
def test_it_is_the_trigonometric_model_where_torques_determine_both(arm):
    train, test = arm
    fit = fit_kernel(train.needs, train, likelihood_samples=30, iterations=20, least_noise=1e-6)
    make = CATALOGUE["trigonometric-kernel"].make
    kernel = make(needs=train.needs, samples=fit.samples).energies(fit.parameters)
    fewer = CATALOGUE["trigonometric"].make(needs=train.needs, degree=1)
    reference = fewer.energies(fit_linear(fewer, train).parameters)
    ask = jax.jit(
        lambda system_of: [
            jax.vmap(system_of.inverse_dynamics)(test.q, test.qd, test.qdd),
            jax.vmap(system_of.mass_matrix)(test.q),
        ],
        static_argnums=0,
    )
    (tau, M), (expected, inertia) = ask(dynamics(kernel)), ask(dynamics(reference))
    np.testing.assert_allclose(tau, expected, rtol=0, atol=1e-3 * abs(expected).max())
    np.testing.assert_allclose(M, inertia, rtol=0, atol=3e-3 * abs(inertia).max())
    np.testing.assert_allclose(tau, test.tau, rtol=0, atol=1e-3 * abs(test.tau).max())
    found = fit.parameters["friction"].coefficients
    for name, expected in COEFFICIENTS.items():
        np.testing.assert_allclose(found[name], expected, rtol=0, atol=5e-3, err_msg=name)
    assert fit.torque_mse < 1e-4 and fit.samples == 60 and fit.parameter_count == 120 + 6


@pytest.mark.slow
def test_slope_of_the_likelihood_is_that_of_its_differences():
    scene = pendulum(friction=0.2)
    data = uniform(scene, samples=20, rate_bound=3.0, acceleration_bound=5.0)
    equations = TorqueEquations(States(data.q, data.qd, data.qdd), np.zeros((20, 0)), data.tau)
    unit = data.tau.std(axis=0)
    start = Unknowns(start_of(scene.needs, False, equations, unit), np.log(0.1 * unit))
    leaves, structure = jax.tree.flatten(start)
    evaluate = jax.jit(likelihood(scene.needs.joints, False))
    _, slopes = evaluate(start, equations)
    for place, slope in enumerate(jax.tree.leaves(slopes)):
        step = 1e-5 * np.ones_like(leaves[place])
        values = []
        for sign in (1, -1):
            moved = [leaf + sign * step if k == place else leaf for k, leaf in enumerate(leaves)]
            values.append(float(evaluate(jax.tree.unflatten(structure, moved), equations)[0]))
        assert (values[0] - values[1]) / 2e-5 == pytest.approx(float(jnp.sum(slope)), rel=1e-4, abs=1e-7)


def test_what_makes_no_kernel_is_refused(arm):
    train, _ = arm
    with pytest.raises(InputError, match="leave load out"):
        fit_kernel(train.needs._replace(joint_friction=("load",)), train)
    with pytest.raises(InputError, match="the needs have 1 joints, the data 2"):
        fit_kernel(pendulum().needs, train)
    with pytest.raises(InputError, match="least_noise is 0"):
        fit_kernel(train.needs, train, least_noise=0.0)
    with pytest.raises(InputError, match="samples is 0; expected a positive whole number"):
        CATALOGUE["trigonometric-kernel"].make(needs=train.needs, samples=0)
