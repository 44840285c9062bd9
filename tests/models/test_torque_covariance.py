"""Covariances of torques: those of the energies' explicit features, and those that the model's energies have."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.mechanics import lagrangian
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.torque_covariance import States, torque_covariance
from dln_jax.models.trigonometric_kernel import make_trigonometric_kernel
from dln_jax.types import Needs

CASES = [(("revolute", "prismatic"), True), (("prismatic", "revolute"), False)]


def drawn(joints, serial, samples=4):
    model = make_trigonometric_kernel(Needs(joints=joints), samples=samples, serial=serial)
    parameters = model.init(jax.random.key(1))
    random = np.random.default_rng(0)
    scales = jax.tree.map(lambda leaf: jnp.asarray(random.uniform(0.5, 2, leaf.shape)), parameters.scales)
    return model, parameters._replace(scales=scales), States(*random.normal(size=(3, 3, len(joints))))


def functions_of(joint, pair, x):
    """Features of a joint: their product at x and y is c(x, y)."""
    of_x = [x] if joint == "prismatic" else [jnp.cos(x), jnp.sin(x)]
    return jnp.sqrt(jnp.stack([pair[0], *[pair[1]] * len(of_x)])) * jnp.stack([jnp.ones_like(x), *of_x])


def features(joints, serial, scales, q, qd):
    """Every function that the energies are made of, written out: as many as there are combinations."""
    entered = jnp.diag(jnp.sqrt(scales.rates)) * qd
    velocity, height, found = (jnp.zeros(0) if serial else entered.sum(axis=0)), jnp.ones(1), []
    for joint, kind in enumerate(joints):
        velocity = jnp.outer(functions_of(kind, scales.turns[joint], q[joint]), velocity).ravel()
        if serial:
            velocity = jnp.append(velocity, entered[joint, joint])
        lift = functions_of(kind, scales.lifts[joint], q[joint])
        height = jnp.outer(jnp.outer(lift, lift) if kind == "prismatic" else lift, height).ravel()
        if serial or joint == len(joints) - 1:
            body = joint if serial else 0
            found.append(jnp.sqrt(scales.inertia[body]) * jnp.outer(velocity, velocity).ravel())
            found.append(jnp.sqrt(scales.weight[body]) * height)
    return jnp.concatenate(found)


@pytest.mark.slow
@pytest.mark.parametrize(("joints", "serial"), CASES)
def test_covariance_is_that_of_explicit_features_and_of_the_energies(joints, serial):
    model, parameters, states = drawn(joints, serial)

    def torque(weights, q, qd, qdd):
        return lagrangian.inverse_dynamics(
            lambda q, qd: weights @ features(joints, serial, parameters.scales, q, qd), q, qd, qdd
        )

    size = features(joints, serial, parameters.scales, *jnp.ones((2, len(joints)))).size
    columns = jax.jit(jax.vmap(jax.jacrev(torque), (None, 0, 0, 0)))(jnp.zeros(size), *map(jnp.asarray, states))
    columns = columns.reshape(-1, size)
    every = States(*map(np.concatenate, zip(states, parameters[:3], strict=True)))  # with the samples of the model
    whole = np.asarray(torque_covariance(joints, serial, parameters.scales, every))
    count = states.q.size
    covariance = whole[:count, :count]
    np.testing.assert_allclose(covariance, columns @ columns.T, rtol=0, atol=1e-12 * float(abs(covariance).max()))

    predicted = whole[:count, count:] @ np.ravel(parameters.weights)
    tau = jax.jit(jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics))(*states)
    np.testing.assert_allclose(tau.ravel(), predicted, rtol=0, atol=1e-12 * float(abs(predicted).max()))


def test_a_chain_without_gravity_and_friction_has_no_such_terms():
    model = make_trigonometric_kernel(Needs(joints=("revolute", "revolute"), gravity=False), samples=3)
    parameters = model.init(jax.random.key(0))
    system = model.energies(parameters)
    assert parameters.scales.weight is None and system.potential is None and system.friction is None
