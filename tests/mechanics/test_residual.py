"""Energies beside those of a tree act as the sum of Lagrangians says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planar_arm import ARM

from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.joint_friction import Load, with_friction
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.mechanics.residual import Residual, with_residual
from dln_jax.mechanics.trees import lagrangian, tree_system
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
TERMS = [("tree", (name,)) for name in Residual._fields] + [(record, Residual._fields) for record in RECORDS]


@pytest.mark.parametrize(("record", "terms"), TERMS)
def test_forces_are_those_of_the_sum_of_energies(record, terms):
    known, L = RECORDS[record]
    residual = Residual(**{name: getattr(RESIDUAL, name) for name in terms})
    friction = joint_dissipation([0.3, 0.1], [0.2, 0.4])

    def energy(q, qd):
        total = L(q, qd)
        if residual.cholesky is not None:
            total += 0.5 * jnp.sum((residual.cholesky(q).T @ qd) ** 2)
        return total if residual.potential is None else total - residual.potential(q)

    def losses(q, qd):
        return friction(q, qd) + (0.0 if residual.dissipation is None else residual.dissipation(q, qd))

    ours = dynamics(with_residual(with_friction(known, friction), residual))
    slow = dynamics(LagrangianSystem(energy, losses))
    q, qd, qdd = STATE
    tau = slow.inverse_dynamics(*STATE)
    np.testing.assert_allclose(ours.inverse_dynamics(*STATE), tau, rtol=1e-12)
    np.testing.assert_allclose(ours.forward_dynamics(q, qd, tau), qdd, rtol=1e-10)
    np.testing.assert_allclose(ours.energy(q, qd), slow.energy(q, qd), rtol=1e-12)
    np.testing.assert_allclose(ours.friction(q, qd), jax.grad(losses, 1)(*map(jnp.asarray, (q, qd))), rtol=1e-12)


def test_transmissions_carry_the_residual_too():
    load = Load(np.array([0.1, 0.2]))
    loaded = with_residual(with_friction(tree_system(ARM), None, load), RESIDUAL)
    link = dynamics(with_residual(tree_system(ARM), RESIDUAL._replace(dissipation=None)))
    q, qd, qdd = STATE
    behind = link.inverse_dynamics(*STATE)
    lost = load.share * np.abs(behind) * np.tanh(qd / load.velocity_scale)
    lost += jax.grad(RESIDUAL.dissipation, 1)(*map(jnp.asarray, (q, qd)))
    tau = dynamics(loaded).inverse_dynamics(*STATE)
    np.testing.assert_allclose(tau, behind + lost, rtol=1e-12)
    np.testing.assert_allclose(dynamics(loaded).forward_dynamics(q, qd, tau), qdd, rtol=1e-10)
