"""The pairwise and the separable Hamiltonian: symmetries and conservation for random parameters, absent terms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.mechanics import hamiltonian
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.models.hamiltonian import make_separable_hamiltonian
from dln_jax.models.n_body import make_pairwise_hamiltonian
from dln_jax.scenes.particles import n_body
from dln_jax.types import InputError, Needs

SMALL = {"width": 5, "depth": 1, "dtype": jnp.float64}
MIXED = Needs(("prismatic", "revolute"), friction=True)
MASSES = np.array([1.0, 2.0, 0.5])


def positions(count, dimension):
    """Needs of bodies."""
    return Needs(("prismatic",) * (count * dimension))


def parameters_of(model):
    """Random ones of the right shapes; none is where it starts."""
    random = np.random.default_rng(8)
    shapes = jax.eval_shape(model.init, jax.random.key(0))
    return jax.tree.map(lambda leaf: jnp.asarray(random.normal(size=leaf.shape, scale=0.6)), shapes)


@functools.cache
def bodies(alike, dimension):
    """A random model of three bodies, and a state."""
    model = make_pairwise_hamiltonian(positions(3, dimension), dimension=dimension, alike=alike, **SMALL)
    parameters = parameters_of(model)
    x, p = jnp.asarray(np.random.default_rng(dimension).normal(size=(2, 3, dimension)))
    return model, parameters, x, p


def rotation(dimension):
    orthogonal, upper = np.linalg.qr(np.random.default_rng(4).normal(size=(dimension, dimension)))
    orthogonal *= np.sign(np.diag(upper))
    orthogonal[:, 0] *= np.linalg.det(orthogonal)
    return orthogonal


@pytest.mark.parametrize(("alike", "dimension"), [(True, 3), (False, 2)])
def test_only_distances_matter(alike, dimension):
    model, parameters, x, p = bodies(alike, dimension)
    H = jax.jit(lambda x, p: flow(model.energies(parameters)).energy(x.ravel(), p.ravel()))
    energy = float(H(x, p))
    turn, order = rotation(dimension), np.array([2, 0, 1])
    assert abs(turn - np.eye(dimension)).max() > 0.3
    assert float(H(x + np.arange(1.0, dimension + 1), p)) == pytest.approx(energy, rel=1e-12)
    assert float(H(x @ turn.T, p @ turn.T)) == pytest.approx(energy, rel=1e-12)
    permuted = float(H(x[order], p[order]))
    if alike:
        assert permuted == pytest.approx(energy, rel=1e-12)
    else:
        assert abs(permuted - energy) > 1e-3
    # They do matter.
    assert abs(float(H(1.1 * x, p)) - energy) > 1e-3 and abs(float(H(x, 1.1 * p)) - energy) > 1e-3


@pytest.mark.parametrize(("alike", "dimension"), [(True, 3), (False, 2)])
def test_momentum_and_angular_momentum_are_conserved(alike, dimension):
    model, parameters, x, p = bodies(alike, dimension)

    @jax.jit
    def field(q, p):
        return hamiltonian.time_derivative(flow(model.energies(parameters)).energy, q, p, jnp.zeros_like(q))

    xd, pd = (np.asarray(rate).reshape(3, dimension) for rate in field(x.ravel(), p.ravel()))
    assert np.abs(pd).max() > 1e-2
    np.testing.assert_allclose(pd.sum(axis=0), 0, atol=1e-13)
    # d/dt of sum x_i ∧ p_i, an antisymmetric matrix in any dimension.
    turning = np.einsum("ia,ib->ab", x, pd) + np.einsum("ia,ib->ab", xd, p)
    np.testing.assert_allclose(turning - turning.T, 0, atol=1e-13)
    inverse_mass = xd / p
    np.testing.assert_allclose(inverse_mass, inverse_mass[:, :1] * np.ones(dimension), rtol=1e-12)
    assert (inverse_mass > 0).all() and (np.ptp(inverse_mass) < 1e-12) == alike


@pytest.mark.parametrize("alike", [True, False])
def test_gravity_is_one_set_of_parameters(alike):
    """w = -G m_i m_j on 1/r, and no network: the textbook's energy and accelerations."""
    masses = np.ones(3) if alike else MASSES
    model = make_pairwise_hamiltonian(positions(3, 2), alike=alike, features=("distance", "inverse"), **SMALL)
    parameters = jax.tree.map(jnp.zeros_like, jax.eval_shape(model.init, jax.random.key(0)))
    parameters["~"]["log_mass"] += np.log(masses[:1] if alike else masses)
    products = masses[[0, 0, 1]] * masses[[1, 2, 2]]
    parameters["pair_linear"]["w"] = (
        parameters["pair_linear"]["w"].at[1].set(-1.7 * (products[:1] if alike else products))
    )
    scene = n_body(3, masses=tuple(float(mass) for mass in masses), G=1.7)
    q, p, tau = jax.random.normal(jax.random.key(2), (3, 6))
    per_coordinate = jnp.repeat(masses, 2)

    @jax.jit
    def ask():
        system = dynamics(model.energies(parameters))
        H = flow(model.energies(parameters)).energy
        return (
            (H(q, p), jnp.sum(p**2 / per_coordinate) / 2 + scene.potential(q)),
            (system.forward_dynamics(q, p / per_coordinate, tau), (tau - scene.gravity(q)) / per_coordinate),
        )

    for got, expected in ask():
        np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-12)


def test_nothing_is_softened():
    model, parameters, x, p = bodies(True, 3)
    H = jax.jit(jax.value_and_grad(lambda q: flow(model.energies(parameters)).energy(q, p.ravel())))
    for gap, finite in ((1e-6, True), (0.0, False)):
        close = np.array(x)
        close[1] = close[0] + gap
        energy, slope = H(close.ravel())
        assert bool(np.isfinite(energy)) == finite and bool(np.isfinite(slope).all()) == finite


def test_the_scale_divides_distances():
    x, p = bodies(True, 3)[2:]
    energies = []
    for scale in (1.0, 2.5):
        model = make_pairwise_hamiltonian(positions(3, 3), dimension=3, distance_scale=scale, **SMALL)
        H = flow(model.energies(bodies(True, 3)[1])).energy
        energies.append(float(jax.jit(H)(scale * x.ravel(), p.ravel())))
    assert energies[0] == pytest.approx(energies[1], rel=1e-13)


def test_absent_features_and_terms_cost_nothing():
    def seen(features):
        model = make_pairwise_hamiltonian(positions(2, 2), features=features, **SMALL)
        parameters = jax.eval_shape(model.init, jax.random.key(0))
        text = str(jax.make_jaxpr(lambda p, q: flow(model.energies(p)).energy(q, q))(parameters, jnp.ones(4)))
        return "= log" in text, sum(leaf.size for leaf in jax.tree.leaves(parameters))

    # A mass, w, and a network of five units; each feature adds a w and five weights.
    assert seen(("distance",)) == (False, 1 + 1 + (5 + 5) + (5 + 1))
    assert seen(("inverse", "logarithm", "distance")) == (True, 1 + 3 + (15 + 5) + (5 + 1))

    def count(needs):
        parameters = jax.eval_shape(make_separable_hamiltonian(needs, **SMALL).init, jax.random.key(0))
        return sum(leaf.size for leaf in jax.tree.leaves(parameters))

    potential, kinetic = 3 * 5 + 5 + 5 + 1, 2 * 5 + 5 + 5 + 1
    assert count(MIXED) == kinetic + potential + 2
    assert count(MIXED._replace(friction=False)) == kinetic + potential
    assert count(MIXED._replace(friction=False, gravity=False)) == kinetic

    def trigonometry(joints):
        model = make_separable_hamiltonian(Needs(joints), **SMALL)
        parameters = jax.eval_shape(model.init, jax.random.key(0))
        text = str(jax.make_jaxpr(lambda p, q: flow(model.energies(p)).energy(q, q))(parameters, jnp.ones(2)))
        return " cos" in text or " sin" in text

    assert trigonometry(("revolute", "prismatic")) and not trigonometry(("prismatic", "prismatic"))


def test_separable_follows_its_energy_without_a_mixed_derivative():
    """At velocities that the network has a momentum for."""
    p = jnp.array([0.6, -0.8])
    model = make_separable_hamiltonian(
        MIXED, momentum_scale=(2.0, 0.5), initial_guess=lambda q, qd: p + 0.01, iterations=6, **SMALL
    )
    parameters = parameters_of(model)
    q, tau = jax.random.normal(jax.random.key(5), (2, 2))

    @jax.jit
    def ask():
        system = dynamics(model.energies(parameters))
        H = flow(model.energies(parameters)).energy
        qd = hamiltonian.velocity(H, q, p)
        qdd = system.forward_dynamics(q, qd, tau)
        friction = jax.nn.softplus(parameters["~"]["viscous_friction"]) * qd
        second = jax.jacfwd(jax.grad(H, argnums=1), argnums=(0, 1))(q, p)
        pd = tau - friction - jax.grad(H)(q, p)
        same = ((system.friction(q, qd), friction), (qdd, second[1] @ pd))
        return same, second, H(q + 1, p) - H(q, p), H(q, p + 1) - H(q, p)

    same, (mixed, curvature), by_position, by_momentum = ask()
    for got, expected in same:
        np.testing.assert_allclose(got, expected, atol=1e-9)
    assert not np.any(mixed) and np.abs(curvature).max() > 1e-3 and np.abs(same[1][0]).max() > 1e-3
    assert abs(by_position) > 1e-3 and abs(by_momentum) > 1e-3


def test_the_momentum_scale_divides_momenta():
    q, p = jax.random.normal(jax.random.key(6), (2, 2))
    scale = (4.0, 0.5)
    scaled, plain = (make_separable_hamiltonian(MIXED, **SMALL, **scales) for scales in ({"momentum_scale": scale}, {}))
    parameters = parameters_of(plain)
    first, second = (jax.jit(flow(model.energies(parameters)).energy) for model in (scaled, plain))
    np.testing.assert_allclose(first(q, p * np.array(scale)), second(q, p), rtol=1e-13)


REFUSED = [
    (lambda: make_pairwise_hamiltonian(positions(1, 2)), "bodies is 1"),
    (lambda: make_pairwise_hamiltonian(positions(2, 1), dimension=0), "dimension is 0"),
    (lambda: make_pairwise_hamiltonian(positions(2, 2), width=0), "width is 0"),
    (lambda: make_pairwise_hamiltonian(positions(2, 2), distance_scale=-1.0), "distance_scale is -1"),
    (lambda: make_pairwise_hamiltonian(positions(2, 2), features=()), "expected some of distance, inverse, logarithm"),
    (lambda: make_pairwise_hamiltonian(positions(2, 2), features=("square",)), "square"),
    (lambda: make_separable_hamiltonian(MIXED, depth=0), "depth is 0"),
    (lambda: make_separable_hamiltonian(MIXED, iterations=0), "iterations is 0"),
    (lambda: make_separable_hamiltonian(MIXED, momentum_scale=(1.0,)), "momentum_scale has 1"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_mistakes_are_named(call, message):
    with pytest.raises(InputError, match=message):
        call()
