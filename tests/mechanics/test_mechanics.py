"""Generic mechanics against the textbook, the structured path against the generic one, and the laws of both."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import slow_among
from hypothesis import given, settings
from hypothesis import strategies as st

from dln_jax.mechanics import closed_form, lagrangian, natural
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.scenes.pendulums import chain, double_pendulum, pendulum
from dln_jax.scenes.poles import cart_pole
from dln_jax.scenes.scene import Scene, closed_form_forward_dynamics

SCENES = [
    pendulum(acceleration=0.0, friction=0.3),
    double_pendulum(friction=0.2),
    cart_pole(),
    chain(1),
    chain(4),
]


class Answers(NamedTuple):
    """Everything that one system says of a batch of states."""

    tau: jax.Array
    accelerations: jax.Array
    energy: jax.Array
    mass: jax.Array
    parts: object
    power: jax.Array


def ask(system: Dynamics, q, qd, qdd, tau) -> Answers:
    return Answers(
        tau=system.inverse_dynamics(q, qd, qdd),
        accelerations=system.forward_dynamics(q, qd, tau),
        energy=system.energy(q, qd),
        mass=system.mass_matrix(q, qd),
        parts=system.decompose(q, qd, qdd),
        power=jax.jvp(system.energy, (q, qd), (qd, qdd))[1],
    )


def natural_twin(scene: Scene) -> Dynamics:
    def cholesky(q):
        return jnp.linalg.cholesky(scene.mass_matrix(q))

    return dynamics(natural.NaturalSystem(cholesky, scene.potential, scene.dissipation))


@pytest.fixture(
    scope="module",
    params=slow_among(SCENES, lambda scene: scene.name == "chain-4"),
    ids=lambda scene: scene.name + scene.needs.friction * "-friction",
)
def answers(request):
    """A scene, 50 random states, and the answers of both paths to them."""
    scene = request.param
    d = scene.needs.degrees_of_freedom
    q, qd, qdd, tau = 2 * jax.random.normal(jax.random.key(0), (4, 50, d))

    # Two programs: batched LAPACK calls that run side by side in one can deadlock on two cores.
    paths = (
        jax.jit(jax.vmap(lambda *state, system=system: ask(system, *state)))
        for system in (dynamics(scene.energies), natural_twin(scene))
    )
    return scene, (q, qd, qdd, tau), *(path(q, qd, qdd, tau) for path in paths)


def relative_error(got, expected):
    got, expected = np.asarray(got), np.asarray(expected)
    return np.abs(got - expected).max() / np.abs(expected).max()


def friction_of(scene, q, qd):
    if scene.dissipation is None:
        return np.zeros(q.shape)
    return np.asarray(jax.jit(jax.vmap(jax.grad(scene.dissipation, argnums=1)))(q, qd))


def test_generic_mechanics_equals_the_textbook(answers):
    scene, state, generic, _ = answers

    @jax.jit
    @jax.vmap
    def textbook(q, qd, qdd, tau):
        torque = closed_form.inverse_dynamics(scene.closed_form, q, qd, qdd)
        return torque, closed_form_forward_dynamics(scene, q, qd, tau), scene.mass_matrix(q)

    torque, accelerations, mass = textbook(*state)
    assert relative_error(generic.tau, torque) < 1e-12
    # An ill-conditioned M amplifies rounding in any method.
    condition = np.linalg.cond(np.asarray(generic.mass)).max()
    assert relative_error(generic.accelerations, accelerations) < max(1e-12, 1e-15 * condition)
    np.testing.assert_allclose(generic.mass, mass, rtol=1e-12, atol=1e-13)


def test_decomposition_equals_the_textbook_and_sums_to_the_total(answers):
    scene, (q, qd, qdd, _), generic, structured = answers
    expected = jax.jit(jax.vmap(lambda *state: closed_form.decompose(scene.closed_form, *state)))(q, qd, qdd)
    scale = float(np.abs(generic.tau).max())
    friction = friction_of(scene, q, qd)
    for got in (generic, structured):
        for part, truth in zip(got.parts, expected, strict=True):
            np.testing.assert_allclose(part, truth, atol=1e-12 * scale)
        np.testing.assert_allclose(sum(map(np.asarray, got.parts)) + friction, got.tau, atol=1e-12 * scale)


def test_structured_path_equals_generic_path(answers):
    _, _, generic, structured = answers
    assert relative_error(structured.tau, generic.tau) < 1e-10
    assert relative_error(structured.accelerations, generic.accelerations) < 1e-10
    assert relative_error(structured.mass, generic.mass) < 1e-10
    assert relative_error(structured.energy, generic.energy) < 1e-10


def test_power_balance(answers):
    """dE/dt = qdᵀ tau - qdᵀ dD/dqd."""
    scene, (q, qd, _, _), generic, structured = answers
    for got in (generic, structured):
        supplied = np.sum(np.asarray(qd) * (np.asarray(got.tau) - friction_of(scene, q, qd)), axis=1)
        np.testing.assert_allclose(got.power, supplied, atol=1e-12 * np.abs(supplied).max())


@functools.cache
def round_trip(d):
    """Both paths' residual of inverse after forward, and of the momentum, compiled once per size."""

    @jax.jit
    def residuals(weights, q, qd, tau):
        def cholesky(q):
            return jnp.tril(jnp.tanh(weights @ q), -1) + jnp.diag(1.0 + jnp.cos(q) ** 2)

        system = natural.NaturalSystem(cholesky, lambda q: jnp.sum(jnp.sin(q) ** 2))
        L = natural.lagrangian(system)
        paths = dynamics(system), dynamics(LagrangianSystem(L))
        residuals = [path.inverse_dynamics(q, qd, path.forward_dynamics(q, qd, tau)) - tau for path in paths]
        return jnp.stack([*residuals, lagrangian.momentum(L, q, qd) - natural.mass_matrix(system, q) @ qd])

    return residuals


@settings(max_examples=30, deadline=None)
@given(d=st.sampled_from([1, 3]), seed=st.integers(0, 2**16))
def test_inverse_after_forward_is_the_identity(d, seed):
    """Random energies of every size, not only textbook ones."""
    random = np.random.default_rng(seed)
    weights = random.normal(size=(d, d, d)) / d
    assert np.abs(round_trip(d)(weights, *random.normal(size=(3, d)))).max() < 1e-10


@pytest.mark.parametrize("condition", [1.0, 1e6, 1e12])
def test_residual_of_solve_does_not_grow_with_condition(condition, d=6):
    """Backward stability (Higham 2002, theorem 9.4): |M qdd + c - tau| within 8 d eps of its terms."""
    vectors = np.linalg.qr(np.random.default_rng(1).normal(size=(d, d)))[0]
    upper = np.linalg.qr(np.sqrt(np.geomspace(1, 1 / condition, d))[:, None] * vectors.T, mode="r")
    factor = upper.T * np.sign(np.diag(upper))
    energies = natural.NaturalSystem(lambda q: (1 + 0.1 * jnp.sin(q[0])) * factor)
    q, qd, qdd = np.random.default_rng(0).uniform(-1, 1, (3, d)) * np.array([[np.pi], [2.0], [5.0]])
    for system in (dynamics(energies), dynamics(LagrangianSystem(natural.lagrangian(energies)))):
        tau = system.inverse_dynamics(q, qd, qdd)
        solved = system.forward_dynamics(q, qd, tau)
        size = abs(factor @ factor.T).sum(axis=1).max() * (abs(qdd).max() + 2 * d * abs(qd).max() ** 2)
        bound = 8 * d * np.finfo(float).eps
        assert abs(system.inverse_dynamics(q, qd, solved) - tau).max() < bound * (size + abs(tau).max())
        assert abs(solved - qdd).max() < bound * condition * (abs(qdd).max() + abs(qd).max() ** 2)


@pytest.mark.slow
def test_chain_of_thirty_equals_closed_form(d=30):
    scene = chain(d)
    q, qd, qdd = np.random.default_rng(0).uniform(-1, 1, (3, d)) * np.array([[np.pi], [2.0], [5.0]])
    expected = closed_form.inverse_dynamics(scene.closed_form, q, qd, qdd)
    assert relative_error(jax.jit(dynamics(scene.energies).inverse_dynamics)(q, qd, qdd), expected) < 1e-12


def test_generic_functions_take_any_lagrangian():
    """A charged particle in a magnetic field: L is linear in qd as well, and M is not its whole story."""

    def L(q, qd):
        return 0.5 * jnp.sum(qd**2) + 0.5 * 1.7 * (q[0] * qd[1] - q[1] * qd[0])

    q, qd = jnp.array([[0.2, 0.9], [1.0, -0.5]])
    acceleration = jax.jit(lambda: lagrangian.forward_dynamics(L, q, qd, jnp.zeros(2)))()
    np.testing.assert_allclose(acceleration, 1.7 * jnp.array([qd[1], -qd[0]]), rtol=1e-13)
    assert lagrangian.energy(L, q, qd) == pytest.approx(0.5 * float(qd @ qd), rel=1e-14)


def test_a_singular_mass_matrix_is_not_hidden():
    def L(q, qd):
        return 0.5 * qd[0] ** 2 - jnp.sum(q**2)

    acceleration = jax.jit(lambda: lagrangian.forward_dynamics(L, jnp.ones(2), jnp.ones(2), jnp.zeros(2)))()
    assert not jnp.isfinite(acceleration).all()
