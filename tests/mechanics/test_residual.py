"""Energies beside those of a tree act as the sum of Lagrangians says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planar_arm import ARM

from dln_jax import joint_dissipation, tree_system
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.joint_friction import Load, with_friction
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.mechanics.residual import Residual, with_residual
from dln_jax.mechanics.trees.recursions import lagrangian
from dln_jax.scenes.pendulums import two_link_arm

STATE = tuple(np.random.default_rng(0).normal(size=(3, 2)))
RESIDUAL = Residual(
    potential=lambda q: jnp.sin(3 * q[0]) * q[1],
    dissipation=lambda q, qd: jnp.sum(jnp.cosh(qd)) * (2 + jnp.cos(q[1])),
    cholesky=lambda q: jnp.array([[1 + q[1] ** 2, 0.0], [jnp.sin(q[0]), 0.5]]),
)


SCENE = two_link_arm()
RECORDS = {
    "tree": (tree_system(ARM), lagrangian(ARM)),
    "closed-form": (SCENE.closed_form, SCENE.lagrangian),
    "natural": (NaturalSystem(lambda q: jnp.linalg.cholesky(SCENE.mass_matrix(q)), SCENE.potential), SCENE.lagrangian),
    "lagrangian": (SCENE.energies, SCENE.lagrangian),
}


@pytest.mark.parametrize("record", RECORDS)
def test_forces_are_those_of_the_sum_of_energies(record):
    known, L = RECORDS[record]
    friction = joint_dissipation([0.3, 0.1], [0.2, 0.4])

    def energy(q, qd):
        return L(q, qd) + 0.5 * jnp.sum((RESIDUAL.cholesky(q).T @ qd) ** 2) - RESIDUAL.potential(q)

    def losses(q, qd):
        return friction(q, qd) + RESIDUAL.dissipation(q, qd)

    @jax.jit
    def ask(q, qd, qdd):
        ours = dynamics(with_residual(with_friction(known, friction), RESIDUAL))
        slow = dynamics(LagrangianSystem(energy, losses))
        tau = slow.inverse_dynamics(q, qd, qdd)
        expected = tau, slow.energy(q, qd), jax.grad(losses, 1)(q, qd), qdd
        return (
            (ours.inverse_dynamics(q, qd, qdd), ours.energy(q, qd), ours.friction(q, qd)),
            ours.forward_dynamics(q, qd, tau),
            expected,
        )

    got, again, (*expected, qdd) = ask(*STATE)
    for one, other in zip(got, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)
    np.testing.assert_allclose(again, qdd, rtol=1e-10)


def test_transmissions_carry_the_residual_too():
    load = Load(np.array([0.1, 0.2]))
    loaded = with_residual(with_friction(tree_system(ARM), None, load), RESIDUAL)
    link = dynamics(with_residual(tree_system(ARM), RESIDUAL._replace(dissipation=None)))
    q, qd, qdd = STATE
    behind = jax.jit(link.inverse_dynamics)(*STATE)
    lost = load.share * np.abs(behind) * np.tanh(qd / load.velocity_scale)
    lost += jax.grad(RESIDUAL.dissipation, 1)(*map(jnp.asarray, (q, qd)))
    motion = dynamics(loaded)
    tau = jax.jit(motion.inverse_dynamics)(*STATE)
    np.testing.assert_allclose(tau, behind + lost, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(motion.forward_dynamics)(q, qd, tau), qdd, rtol=1e-10)
