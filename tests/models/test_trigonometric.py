"""The model that is linear in its parameters, and the least squares that identifies it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from furuta import SCENE

from dln_jax.data.splits import split
from dln_jax.learning.linear import choose_degrees, fit_linear
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.explicit import closed_form
from dln_jax.models.model import Model
from dln_jax.models.trigonometric import make_trigonometric
from dln_jax.scenes.datasets.generators import uniform
from dln_jax.scenes.pendulums import cart_pole, pendulum, two_link_arm
from dln_jax.solvers.least_squares import solve, solve_chunks
from dln_jax.types import Needs

ARM = two_link_arm()


@functools.cache
def sampled(scene):
    return uniform(scene, samples=600)


@pytest.mark.parametrize(
    ("scene", "friction"),
    [(cart_pole(friction=0.2), 0.2), (pendulum(acceleration=0.0), None)],
    ids=["cart", "free"],
)
def test_textbook_scenes_are_identified_to_rounding(scene, friction):
    """Torques, mass matrices and friction; accelerations, energies and parts follow for all parameters."""
    data = sampled(scene)
    model = make_trigonometric(scene.needs)
    fit = fit_linear(model, data)
    assert fit.rank == fit.parameter_count == sum(leaf.size for leaf in jax.tree.leaves(fit.parameters))
    assert 1 <= fit.condition < 1e4
    assert fit.torque_mse < 1e-22 * float(data.tau.var(axis=0).sum())
    masses, expected = jax.vmap(dynamics(model.energies(fit.parameters)).mass_matrix), jax.vmap(scene.mass_matrix)
    np.testing.assert_allclose(masses(data.q), expected(data.q), atol=1e-10)
    if friction is None:
        assert fit.parameters.friction is None
    else:
        np.testing.assert_allclose(fit.parameters.friction, friction, rtol=1e-11)


def test_an_indefinite_mass_matrix_is_used_and_a_singular_one_not_hidden():
    model = make_trigonometric(ARM.needs)
    start = model.init(jax.random.key(0))
    q, qd, qdd = np.random.default_rng(2).normal(size=(3, 2))
    indefinite = np.random.default_rng(3).normal(size=start.mass.shape)

    @jax.jit
    def evaluate(mass):
        system = dynamics(model.energies(start._replace(mass=mass)))
        return system.mass_matrix(q), system.inverse_dynamics(q, qd, system.forward_dynamics(q, qd, qdd))

    mass, again = evaluate(indefinite)
    assert np.linalg.eigvalsh(mass).min() < 0
    np.testing.assert_allclose(again, qdd, rtol=1e-12)
    assert not jnp.isfinite(evaluate(0 * indefinite)[1]).all()


def test_a_prismatic_joint_may_have_a_spring():
    start = make_trigonometric(Needs(("prismatic",)), degree=1).init(jax.random.key(0))
    assert start.mass.shape == (1, 2) and start.potential.shape == (2,)


def test_precision_does_not_depend_on_the_caller():
    """Computed in float64 for a single-precision model in a single-precision program, and in chunks of any size."""
    train = sampled(ARM)
    with jax.enable_x64(False):
        fit = fit_linear(make_trigonometric(ARM.needs, dtype=jnp.float32), train, chunk_size=170)
    assert {leaf.dtype for leaf in jax.tree.leaves(fit.parameters)} == {jnp.dtype("float32")}
    assert fit.torque_mse < 1e-22
    # The first two functions of the basis are 1 and cos q2; rows are M11, M21 and M22 of the published arm.
    expected = np.zeros((3, 9))
    expected[:, :2] = [[1.3727291666666667, 1.0], [0.5176145833333333, 0.5], [0.5176145833333333, 0.0]]
    np.testing.assert_allclose(fit.parameters.mass, expected, atol=1e-6)
    assert fit_linear(make_trigonometric(ARM.needs), train, ridge=1.0).torque_mse > 0.1


def nonlinear() -> Model:
    def energies(parameters):
        mass = jnp.diag((1 + parameters) ** 2)
        return closed_form(lambda q: mass, lambda q, qd: 0 * qd)

    return Model(lambda key: jnp.zeros(2), energies)


def test_mistakes_are_named():
    for run, message in [
        (lambda: make_trigonometric(ARM.needs, degree=-1), "degree is -1; expected a whole number >= 0"),
        (lambda: make_trigonometric(ARM.needs, degree=(1,)), r"degree is \(1,\); .* each of the 2 joints"),
        (lambda: fit_linear(nonlinear(), sampled(ARM)), "not linear in its parameters"),
        (lambda: fit_linear(nonlinear(), sampled(ARM), chunk_size=0), "chunk_size is 0"),
        (lambda: solve(np.eye(2), np.ones(2), ridge=-1.0), "ridge is -1.0"),
        (lambda: solve(np.eye(2), np.ones(2), rank_tolerance=1.0), "rank_tolerance is 1.0"),
        (lambda: solve(np.eye(2), np.array([1.0, np.nan])), "NaN or infinite"),
        (lambda: solve_chunks([]), "no equations"),
    ]:
        with one_line(message):
            run()


def test_rank_condition_and_the_shortest_solution():
    random = np.random.default_rng(6)
    q, _ = np.linalg.qr(random.normal(size=(50, 3)))
    cosine = 0.6
    # Two columns at a known angle, a copy of the second, and one of zeros.
    slanted = cosine * q[:, 0] + (1 - cosine**2) ** 0.5 * q[:, 1]
    A = np.stack([q[:, 0], slanted, 1e3 * slanted, np.zeros(50)], axis=1)
    solution = solve(A, A @ np.array([1.0, 2.0, 0.0, 5.0]))
    np.testing.assert_allclose(solution.x, [1.0, 1.0, 1e-3, 0.0], rtol=1e-13)
    assert solution.rank == 2
    # Gram matrix [[1, c√2], [c√2, 2]] of the first and the merged pair.
    sizes = np.linalg.eigvalsh([[1.0, cosine * 2**0.5], [cosine * 2**0.5, 2.0]])
    assert solution.condition == pytest.approx((sizes[1] / sizes[0]) ** 0.5, rel=1e-12)
    assert solve(A, A @ np.ones(4), rank_tolerance=0.9).rank == 1
    nothing = solve(np.zeros((3, 2)), np.ones(3))
    assert nothing.rank == 0 and not nothing.x.any() and nothing.condition == np.inf
    assert nothing.residual == pytest.approx(3**0.5)
    b = random.normal(size=50)
    np.testing.assert_allclose(solve_chunks((q[k : k + 20], b[k : k + 20]) for k in (0, 20, 40)).x, q.T @ b, rtol=1e-12)
    shrunk = solve(q, q @ np.array([3.0, -2.0, 1.0]), ridge=0.5)
    np.testing.assert_allclose(shrunk.x, np.array([3.0, -2.0, 1.0]) / 1.5, rtol=1e-13)


def test_validation_gives_each_joint_the_degree_that_it_needs():
    """A pendulum on an arm that turns about the vertical: sin² has degree 2, and nothing depends on the yaw."""
    data = uniform(SCENE, samples=400)
    noise = 1e-3 * data.tau.std(axis=0)
    data = data._replace(tau=data.tau + noise * np.random.default_rng(0).normal(size=data.tau.shape))
    sets = split(data)
    chosen, _ = choose_degrees(SCENE.needs, sets.train, sets.validation)
    assert chosen.candidate == (0, 2) and chosen.outcome.torque_mse == pytest.approx(noise[0] ** 2, rel=0.2)
