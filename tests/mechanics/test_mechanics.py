"""Every record of a scene's energies against the textbook, and the accuracy of the solver."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.mechanics import lagrangian, natural
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.mechanics.hamiltonian import HamiltonianSystem, legendre
from dln_jax.scenes.pendulums import cart_pole, double_pendulum, pendulum
from dln_jax.scenes.scene import closed_form_forward_dynamics

SCENES = [pendulum(acceleration=0.0, friction=0.3), double_pendulum(friction=0.2), cart_pole()]


def relative_error(got, expected):
    got, expected = np.asarray(got), np.asarray(expected)
    return np.abs(got - expected).max() / np.abs(expected).max()


PATHS = {
    "lagrangian": lambda scene: scene.energies,
    "natural": lambda scene: natural.NaturalSystem(
        lambda q: jnp.linalg.cholesky(scene.mass_matrix(q)), scene.potential, scene.dissipation
    ),
    "natural hamiltonian": lambda scene: natural.NaturalHamiltonian(
        lambda q: jnp.linalg.cholesky(jnp.linalg.inv(scene.mass_matrix(q))), scene.potential, scene.dissipation
    ),
    "hamiltonian": lambda scene: HamiltonianSystem(legendre(scene.lagrangian), scene.dissipation),
}


CASES = [(scene, path) for scene in SCENES for path in PATHS if path != "hamiltonian" or scene is SCENES[0]]


@pytest.mark.parametrize(("scene", "path"), CASES, ids=lambda case: getattr(case, "name", case))
@pytest.mark.as_users_compile
def test_every_path_equals_the_textbook_and_balances_power(scene, path):
    """Forces, accelerations, M and the parts of a force; dE/dt = qdᵀ tau - qdᵀ dD/dqd; H(q, M qd) is the energy."""
    energies = PATHS[path](scene)
    system = dynamics(energies)

    @jax.jit
    @jax.vmap
    def ask(q, qd, qdd, tau):
        energy, power = jax.jvp(system.energy, (q, qd), (qd, qdd))
        answers = system.inverse_dynamics(q, qd, qdd), system.forward_dynamics(q, qd, tau), system.mass_matrix(q, qd)
        H = energy if path == "lagrangian" else flow(energies).energy(q, scene.mass_matrix(q) @ qd)
        return answers, system.decompose(q, qd, qdd), (energy, H), power

    @jax.jit
    @jax.vmap
    def textbook(q, qd, qdd, tau):
        known, mass = dynamics(scene.closed_form), scene.mass_matrix(q)
        friction = jnp.zeros_like(q) if scene.dissipation is None else jax.grad(scene.dissipation, 1)(q, qd)
        torque = known.inverse_dynamics(q, qd, qdd)
        answers = torque, closed_form_forward_dynamics(scene, q, qd, tau), mass
        energy = qd @ mass @ qd - scene.lagrangian(q, qd)
        return answers, known.decompose(q, qd, qdd), energy, qd @ (torque - friction), friction

    state = 2 * np.random.default_rng(0).normal(size=(4, 50, scene.needs.degrees_of_freedom))
    answers, parts, energy, power = ask(*state)
    expected, parts_expected, energy_expected, supplied, friction = textbook(*state)
    for got, truth in zip(answers, expected, strict=True):
        assert relative_error(got, truth) < (1e-12 if path == "lagrangian" else 1e-10)
    scale = np.abs(expected[0]).max()
    for part, truth in zip(parts, parts_expected, strict=True):
        np.testing.assert_allclose(part, truth, atol=1e-12 * scale)
    np.testing.assert_allclose(sum(map(np.asarray, parts)) + friction, expected[0], atol=1e-12 * scale)
    for each in energy:
        assert relative_error(each, energy_expected) < 1e-10
    np.testing.assert_allclose(power, supplied, atol=1e-12 * np.abs(supplied).max())


def test_residual_of_solve_does_not_grow_with_condition(d=6):
    """Backward stability (Higham 2002, theorem 9.4): |M qdd + c - tau| within 8 d eps of its terms."""
    vectors = np.linalg.qr(np.random.default_rng(1).normal(size=(d, d)))[0]
    q, qd, qdd = np.random.default_rng(0).uniform(-1, 1, (3, d)) * np.array([[np.pi], [2.0], [5.0]])

    @jax.jit
    def ask(factor):
        system = dynamics(natural.NaturalSystem(lambda q: (1 + 0.1 * jnp.sin(q[0])) * factor))
        tau = system.inverse_dynamics(q, qd, qdd)
        solved = system.forward_dynamics(q, qd, tau)
        return tau, solved, system.inverse_dynamics(q, qd, solved)

    for condition in (1.0, 1e12):
        upper = np.linalg.qr(np.sqrt(np.geomspace(1, 1 / condition, d))[:, None] * vectors.T, mode="r")
        factor = upper.T * np.sign(np.diag(upper))
        tau, solved, again = ask(factor)
        size = abs(factor @ factor.T).sum(axis=1).max() * (abs(qdd).max() + 2 * d * abs(qd).max() ** 2)
        bound = 8 * d * np.finfo(float).eps
        assert abs(again - tau).max() < bound * (size + abs(tau).max())
        assert abs(solved - qdd).max() < bound * condition * (abs(qdd).max() + abs(qd).max() ** 2)


def test_a_singular_mass_matrix_is_not_hidden():
    def L(q, qd):
        return 0.5 * qd[0] ** 2 - jnp.sum(q**2)

    assert not jnp.isfinite(lagrangian.forward_dynamics(L, *jnp.ones((3, 2)))).all()
