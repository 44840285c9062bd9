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


def test_torques_of_a_chain_do_not_depend_on_what_physics_leaves_out():
    """Kinetic energy on the first joint's angle; without gravity and friction there is no such term."""
    joints = ("revolute", "revolute")
    model = make_trigonometric_kernel(Needs(joints=joints, gravity=False), samples=3)
    parameters = model.init(jax.random.key(0))
    assert parameters.scales.weight is None
    system = model.energies(parameters)
    assert system.potential is None and system.friction is None
    M = jax.jit(jax.vmap(system.mass_matrix))(jnp.array([[0.0, 0.7], [2.0, 0.7], [2.0, -0.4]]))
    np.testing.assert_allclose(M[0], M[1], rtol=1e-12)
    assert abs(M[2] - M[1]).max() > 0.1
    np.testing.assert_allclose(M, M.swapaxes(1, 2), rtol=1e-12)


def test_power_is_the_rate_of_energy_and_accelerations_are_those_of_the_torques():
    model, parameters, states = drawn(("prismatic", "revolute"), True)
    motion = dynamics(model.energies(parameters))

    @jax.jit
    def ask(q, qd, qdd):
        tau = motion.inverse_dynamics(q, qd, qdd)
        _, rate = jax.jvp(motion.energy, (q, qd), (qd, qdd))
        return tau, rate, motion.forward_dynamics(q, qd, tau)

    q, qd, qdd = (each[0] for each in states)
    tau, rate, accelerations = ask(q, qd, qdd)
    np.testing.assert_allclose(rate, qd @ tau, rtol=1e-10)
    np.testing.assert_allclose(accelerations, qdd, rtol=1e-8)
