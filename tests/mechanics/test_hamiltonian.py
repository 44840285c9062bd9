"""Hamilton's equations against the textbook's Lagrangian ones, conjugate momenta, and the solver below them."""

import jax
import jax.numpy as jnp
import numpy as np
from calls import one_line

from dln_jax.mechanics import hamiltonian
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.hamiltonian import HamiltonianSystem, conjugate, legendre
from dln_jax.scenes import scene as textbook
from dln_jax.scenes.pendulums import cart_pole
from dln_jax.solvers.elimination import solve


def test_elimination_equals_lapack():
    for n in (1, 4, 17):
        random = np.random.default_rng(n)
        matrices = random.normal(size=(20, n, n))
        # A zero diagonal, and a first column that grows downwards: wrong or lost without exchanging rows.
        matrices[10:15] = np.roll(matrices[10:15] / 5 + np.eye(n), 1, axis=1)
        matrices[15:, :, 0] *= 10.0 ** np.arange(n) * 1e-14 ** (np.arange(n) == 0)
        right = random.normal(size=(20, n, 2))
        expected = np.linalg.solve(matrices, right)
        got = jax.jit(jax.vmap(solve))(matrices, right)
        scale = np.linalg.cond(matrices)[:, None, None] * np.abs(expected).max(axis=(1, 2), keepdims=True)
        assert np.max(np.abs(got - expected) / scale) < 1e-14
    assert not np.isfinite(solve(np.ones((2, 2)), np.array([1.0, 2.0]))).any(), "a singular matrix"


def assert_equal(got, expected):
    """To 1e-10 of the largest number; a force that the scene lacks to the same of 1."""
    scale = float(jnp.max(jnp.abs(expected))) or 1.0
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-10 * scale)


def test_hamiltons_equations_are_those_of_the_textbook():
    """(qd, pd) from the closed-form acceleration, and dH/dt = qd·tau - qd·dD/dqd along them."""
    scene = cart_pole(friction=0.3)
    H = legendre(scene.lagrangian)
    q, qd, tau = jnp.asarray(np.random.default_rng(2).normal(size=(3, 20, 2)))

    @jax.jit
    @jax.vmap
    def ask(q, qd, tau):
        acceleration = textbook.closed_form_forward_dynamics(scene, q, qd, tau)
        p, pd = jax.jvp(lambda q, qd: scene.mass_matrix(q) @ qd, (q, qd), (qd, acceleration))
        friction = jax.grad(scene.dissipation, argnums=1)(q, qd)
        field = hamiltonian.time_derivative(H, q, p, tau, dissipation=scene.dissipation)
        balance = jax.jvp(H, (q, p), field)[1]
        got = *field, hamiltonian.inverse(H, q, p, pd), hamiltonian.velocity(H, q, p), balance
        return got, (qd, pd, tau - friction, qd, qd @ tau - qd @ friction)

    jax.tree.map(assert_equal, *ask(q, qd, tau))


def test_conjugate_differentiates_as_the_implicit_function():
    """f = a cosh x has f' = y at x = arcsinh(y / a): every derivative, also in what f closes over."""

    def got(a, y):
        return conjugate(lambda q, x: jnp.sum(a * jnp.cosh(x) + q * x), jnp.zeros(2), y, iterations=8)[0]

    def expected(a, y):
        return jnp.arcsinh(y / a)[0]

    a, y = jnp.array([1.3, 0.8]), jnp.array([0.5, -0.3])

    def derivatives(function):
        third = jax.jacfwd(jax.hessian(function, argnums=1), argnums=0)
        return jax.jit(lambda: (function(a, y), *jax.grad(function, argnums=(0, 1))(a, y), third(a, y)))()

    for one, other in zip(derivatives(got), derivatives(expected), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-13)


def test_a_velocity_without_a_momentum_gives_nan_in_value_and_derivative():
    """With H = sqrt(1 + p²) no momentum makes |qd| = 1 or more; just below, p = qd / sqrt(1 - qd²)."""
    qd = np.array([[0.0], [0.6], [0.99], [1.0], [1.2]])

    @jax.vmap
    @jax.value_and_grad
    def momentum(qd):
        return conjugate(lambda q, p: jnp.sum(jnp.sqrt(1 + p**2)), qd, qd)[0]

    value, slope = jax.jit(momentum)(qd)
    np.testing.assert_allclose(value[:3], [0, 0.75, 0.99 / np.sqrt(1 - 0.99**2)], rtol=1e-12)
    np.testing.assert_allclose(slope[:3, 0], (1 - qd[:3, 0] ** 2) ** -1.5, rtol=1e-10)
    assert np.isnan(value[3:]).all() and np.isnan(slope[3:]).all()


def test_a_charged_particle_in_a_magnetic_field():
    """H = ½ |p - A(q)|² is not a natural system: the velocity turns at the cyclotron rate."""

    def H(q, p):
        return 0.5 * jnp.sum((p - 0.85 * jnp.array([-q[1], q[0]])) ** 2)

    q, qd = jnp.array([[0.2, 0.9], [1.0, -0.5]])
    system = dynamics(HamiltonianSystem(H))
    acceleration = 1.7 * jnp.array([qd[1], -qd[0]])

    @jax.jit
    def ask():
        return system.forward_dynamics(q, qd, jnp.zeros(2)), system.decompose(q, qd, q)

    got, (inertial, coriolis, gravity) = ask()
    np.testing.assert_allclose(got, acceleration, rtol=1e-13)
    np.testing.assert_allclose(inertial, q, rtol=1e-13)
    np.testing.assert_allclose(coriolis, -acceleration, rtol=1e-13)
    np.testing.assert_allclose(gravity, 0, atol=1e-14)


def test_no_iterations_are_refused():
    with one_line("iterations is 0"):
        dynamics(HamiltonianSystem(lambda q, p: jnp.sum(p**2), iterations=0))
    with one_line("iterations is -1"):
        conjugate(lambda q, p: jnp.sum(p**2), jnp.zeros(1), jnp.zeros(1), iterations=-1)
