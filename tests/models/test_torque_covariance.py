"""The covariance of torques is that of the model's energies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.mechanics.equations import dynamics
from dln_jax.models.kernel import make_trigonometric_kernel, torque_covariance
from dln_jax.types import Needs


@pytest.mark.parametrize("serial", [True, False])
def test_covariance_is_that_of_the_energies(serial):
    """Torques of random weights at the model's samples, through the covariance and through the energies."""
    joints = ("revolute", "prismatic")
    model = make_trigonometric_kernel(Needs(joints=joints), samples=3, serial=serial)
    parameters = model.init(jax.random.key(1))
    random = np.random.default_rng(0)
    scales = jax.tree.map(lambda leaf: jnp.asarray(random.uniform(0.5, 2, leaf.shape)), parameters.scales)
    parameters, states = parameters._replace(scales=scales), tuple(random.normal(size=(3, 2, 2)))
    every = tuple(map(np.concatenate, zip(states, parameters[:3], strict=True)))  # with the samples of the model
    whole = np.asarray(torque_covariance(joints, serial, parameters.scales, every))
    np.testing.assert_allclose(whole, whole.T, rtol=0, atol=1e-12 * abs(whole).max())
    sizes = np.linalg.eigvalsh(whole)
    assert sizes.min() > -1e-12 * sizes.max()
    predicted = whole[: states[0].size, states[0].size :] @ np.ravel(parameters.weights)
    tau = jax.jit(jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics))(*states)
    np.testing.assert_allclose(tau.ravel(), predicted, rtol=0, atol=1e-12 * float(abs(predicted).max()))


def test_a_chain_without_gravity_and_friction_has_no_such_terms():
    model = make_trigonometric_kernel(Needs(joints=("revolute", "revolute"), gravity=False), samples=3)
    parameters = model.init(jax.random.key(0))
    system = model.energies(parameters)
    assert parameters.scales.weight is None and system.potential is None and system.friction is None
