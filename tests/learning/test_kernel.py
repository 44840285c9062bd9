"""Kernel energies fitted to torques: exact where the basis is, friction beside them, the likelihood's slope."""

import jax
import numpy as np
import pytest
from calls import one_line
from jax.flatten_util import ravel_pytree

from dln_jax.data.splits import select
from dln_jax.learning.kernel import fit_kernel, likelihood, start_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.datasets.generators import uniform
from dln_jax.scenes.pendulums import pendulum, two_link_arm
from dln_jax.zoo.descriptions import make

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


def test_torques_and_friction_are_found_where_the_basis_is_exact(arm):
    train, test = arm
    fit = fit_kernel(train.needs, train, likelihood_samples=30, iterations=20, least_noise=1e-6)
    model = make("trigonometric-kernel", train.needs, samples=fit.samples)
    torque = jax.jit(jax.vmap(dynamics(model.energies(fit.parameters)).inverse_dynamics))
    tau = torque(test.q, test.qd, test.qdd)
    np.testing.assert_allclose(tau, test.tau, rtol=0, atol=1e-3 * abs(test.tau).max())
    found = fit.parameters["friction"].coefficients
    for name, expected in COEFFICIENTS.items():
        np.testing.assert_allclose(found[name], expected, rtol=0, atol=5e-3, err_msg=name)
    assert fit.torque_mse < 1e-4 and fit.samples == 60 and fit.parameter_count == 120 + 6


@pytest.mark.slow
def test_slope_of_the_likelihood_is_that_of_its_differences():
    scene = pendulum(friction=0.2)
    data = uniform(scene, samples=20, rate_bound=3.0, acceleration_bound=5.0)
    equations = (data.q, data.qd, data.qdd), np.zeros((20, 0)), data.tau
    unit = data.tau.std(axis=0)
    start = start_of(scene.needs, False, equations, unit), np.log(0.1 * unit)
    flat, unravel = ravel_pytree(start)
    evaluate = jax.jit(likelihood(scene.needs.joints, False))
    slope = ravel_pytree(evaluate(start, equations)[1])[0]
    for place, unit in enumerate(1e-5 * np.eye(flat.size)):
        higher, lower = (float(evaluate(unravel(flat + sign * unit), equations)[0]) for sign in (1, -1))
        assert (higher - lower) / 2e-5 == pytest.approx(float(slope[place]), rel=1e-4, abs=1e-7)


def test_what_makes_no_kernel_is_refused(arm):
    train, _ = arm
    for call, message in [
        (lambda: fit_kernel(train.needs._replace(joint_friction=("load",)), train), "leave load out"),
        (lambda: fit_kernel(pendulum().needs, train), "the needs have 1 joints, the data 2"),
        (lambda: fit_kernel(train.needs, train, least_noise=0.0), "least_noise is 0"),
        (lambda: make("trigonometric-kernel", train.needs, samples=0), "samples is 0; expected a pos"),
    ]:
        with one_line(message):
            call()
