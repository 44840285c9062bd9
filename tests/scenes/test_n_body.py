"""The pairwise Hamiltonian: its symmetries, and Newton's gravity as one set of its parameters."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.models.hamiltonian import make_pairwise_hamiltonian
from dln_jax.scenes.particles import n_body
from dln_jax.types import Needs
from tests.models.random_parameters import drawn

SMALL = {"width": 5, "depth": 1, "dtype": jnp.float64}
MASSES = np.array([1.0, 2.0, 0.5])


def positions(count, dimension):
    """Needs of bodies."""
    return Needs(("prismatic",) * (count * dimension))


@functools.cache
def bodies(alike, dimension):
    """A random model of three bodies, and a state."""
    model = make_pairwise_hamiltonian(positions(3, dimension), dimension=dimension, alike=alike, **SMALL)
    parameters = drawn(model)
    x, p = jnp.asarray(np.random.default_rng(dimension).normal(size=(2, 3, dimension)))
    return model, parameters, x, p


@pytest.mark.parametrize(("alike", "dimension"), [(True, 3), (False, 2)])
def test_only_distances_matter(alike, dimension):
    model, parameters, x, p = bodies(alike, dimension)
    H = jax.jit(lambda x, p: flow(model.energies(parameters)).energy(x.ravel(), p.ravel()))
    energy = float(H(x, p))
    turn, upper = np.linalg.qr(np.random.default_rng(4).normal(size=(dimension, dimension)))
    turn *= np.sign(np.diag(upper))
    order = np.array([2, 0, 1])
    assert abs(turn - np.eye(dimension)).max() > 0.3
    assert float(H(x + np.arange(1.0, dimension + 1), p)) == pytest.approx(energy, rel=1e-12)
    assert float(H(x @ turn.T, p @ turn.T)) == pytest.approx(energy, rel=1e-12)
    assert (abs(float(H(x[order], p[order])) - energy) < 1e-12 * abs(energy)) == alike
    # They do matter.
    assert abs(float(H(1.1 * x, p)) - energy) > 1e-3 and abs(float(H(x, 1.1 * p)) - energy) > 1e-3


def test_gravity_is_one_set_of_parameters():
    """w = -G m_i m_j on 1/r, and no network: the textbook's energy and accelerations."""
    model = make_pairwise_hamiltonian(positions(3, 2), alike=False, features=("distance", "inverse"), **SMALL)
    parameters = jax.tree.map(jnp.zeros_like, jax.eval_shape(model.init, jax.random.key(0)))
    parameters["~"]["log_mass"] += np.log(MASSES)
    weights = parameters["pair_linear"]["w"]
    products = MASSES[[0, 0, 1]] * MASSES[[1, 2, 2]]
    parameters["pair_linear"]["w"] = weights.at[1].set(-1.7 * products)
    scene = n_body(3, masses=tuple(map(float, MASSES)), G=1.7)
    q, p, tau = jax.random.normal(jax.random.key(2), (3, 6))
    mass = jnp.repeat(MASSES, 2)

    @jax.jit
    def ask():
        energies = model.energies(parameters)
        return flow(energies).energy(q, p), dynamics(energies).forward_dynamics(q, p / mass, tau)

    energy, accelerations = ask()
    np.testing.assert_allclose(energy, jnp.sum(p**2 / mass) / 2 + scene.potential(q), rtol=1e-11)
    np.testing.assert_allclose(accelerations, (tau - scene.gravity(q)) / mass, rtol=1e-11, atol=1e-12)


def test_nothing_is_softened():
    model, parameters, x, p = bodies(True, 3)
    H = jax.jit(jax.value_and_grad(lambda q: flow(model.energies(parameters)).energy(q, p.ravel())))
    for gap, finite in ((1e-6, True), (0.0, False)):
        close = np.array(x)
        close[1] = close[0] + gap
        energy, slope = H(close.ravel())
        assert bool(np.isfinite(energy)) == finite and bool(np.isfinite(slope).all()) == finite


def test_the_scale_divides_distances():
    model, parameters, x, p = bodies(True, 3)
    scaled = make_pairwise_hamiltonian(positions(3, 3), dimension=3, distance_scale=2.5, **SMALL)
    near, far = (flow(each.energies(parameters)).energy for each in (model, scaled))
    np.testing.assert_allclose(far(2.5 * x.ravel(), p.ravel()), near(x.ravel(), p.ravel()), rtol=1e-13)


def test_mistakes_are_named():
    pair = functools.partial(make_pairwise_hamiltonian, positions(2, 2))
    for call, message in [
        (lambda: make_pairwise_hamiltonian(positions(1, 2)), "bodies is 1"),
        (lambda: pair(dimension=0), "dimension is 0"),
        (lambda: pair(width=0), "width is 0"),
        (lambda: pair(distance_scale=-1.0), "distance_scale is -1"),
        (lambda: pair(features=()), "expected some of distance, inverse, logarithm"),
        (lambda: pair(features=("square",)), "square"),
    ]:
        with one_line(message):
            call()
