"""The Hamiltonian, black-box and feed-forward models: physics for random parameters, scales, absent terms, reports."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from costs import flops_and_parameters

from dln_jax.mechanics import hamiltonian
from dln_jax.mechanics.dynamics import PlainDynamics
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.metrics.definiteness import definiteness
from dln_jax.models.baselines import make_feed_forward
from dln_jax.models.hamiltonian import make_black_box_hamiltonian, make_structured_hamiltonian
from dln_jax.models.lagrangian import make_black_box_lagrangian, make_delan
from dln_jax.types import InputError, Needs
from dln_jax.zoo.run import compiled

NOMINAL = [make_structured_hamiltonian, make_black_box_hamiltonian, make_black_box_lagrangian, make_feed_forward]
MIXED = Needs(("prismatic", "revolute"), friction=True)
SMALL = {"width": 5, "depth": 1, "dtype": jnp.float64}


def friction(parameters, qd):
    return jax.nn.softplus(parameters["~"]["viscous_friction"]) * qd


def test_structured_hamiltonian_holds_for_random_parameters():
    d = 3
    needs = Needs(("revolute",) * d, friction=True)
    model = make_structured_hamiltonian(needs, **SMALL)
    q, qd, tau, p = jax.random.normal(jax.random.key(d), (4, d))

    @jax.jit
    def evaluate(key):
        parameters = model.init(key)
        system, H = dynamics(model.energies(parameters)), flow(model.energies(parameters)).energy
        L = model.energies(parameters).inverse_factor(q)
        mass = system.mass_matrix(q)
        qdd = system.forward_dynamics(q, qd, tau)
        rate = jax.jvp(system.energy, (q, qd), (qd, qdd))[1]
        # Hamilton's equations by differentiating H alone, at the momentum that M gives.
        field = hamiltonian.time_derivative(H, q, mass @ qd, tau - friction(parameters, qd))
        momentum_rate = jax.jvp(lambda q, qd: system.mass_matrix(q) @ qd, (q, qd), (qd, qdd))[1]
        parts = sum(system.decompose(q, qd, qdd)) + friction(parameters, qd)
        hessian = jax.hessian(H, argnums=1)(q, p)
        return (
            (hessian, L @ L.T),
            (mass @ L @ L.T, jnp.eye(d)),
            (system.inverse_dynamics(q, qd, qdd), tau),
            (parts, tau),
            (rate, qd @ (tau - friction(parameters, qd))),
            (field, (qd, momentum_rate)),
            (system.energy(q, qd), H(q, mass @ qd)),
        )

    for got, expected in evaluate(jax.random.key(0)):
        jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, atol=1e-11), got, expected)


def test_black_box_lagrangian_follows_its_energy():
    model = make_black_box_lagrangian(MIXED, **SMALL)
    q, qd, tau = jax.random.normal(jax.random.key(3), (3, 2))

    @jax.jit
    def evaluate(key):
        parameters = model.init(key)
        system = dynamics(model.energies(parameters))
        qdd = system.forward_dynamics(q, qd, tau)
        rate = jax.jvp(system.energy, (q, qd), (qd, qdd))[1]
        return system.inverse_dynamics(q, qd, qdd) - tau, rate - qd @ (tau - friction(parameters, qd))

    torque, balance = evaluate(jax.random.key(0))
    np.testing.assert_allclose(torque, 0, atol=1e-10)
    np.testing.assert_allclose(balance, 0, atol=1e-10)


def test_black_box_hamiltonian_follows_its_energy():
    """At velocities that the network has a momentum for; its parameters' gradient against differences."""
    p = jnp.array([0.6, -0.8])
    model = make_black_box_hamiltonian(MIXED, initial_guess=lambda q, qd: p + 0.01, **SMALL)
    q, tau, direction = jax.random.normal(jax.random.key(5), (3, 2))
    parameters = jax.jit(model.init)(jax.random.key(1))

    @jax.jit
    def evaluate(parameters, qd):
        system = dynamics(model.energies(parameters))
        qdd = system.forward_dynamics(q, qd, tau)
        return system.energy(q, qd), system.inverse_dynamics(q, qd, qdd)

    H = flow(model.energies(parameters)).energy
    expected, qd = jax.jit(lambda: (H(q, p), hamiltonian.velocity(H, q, p)))()
    energy, again = evaluate(parameters, qd)
    assert float(energy) == pytest.approx(float(expected), rel=1e-12)
    np.testing.assert_allclose(again, tau, atol=1e-9)

    @jax.jit
    def loss(step):
        moved = jax.tree.map(lambda leaf: leaf + step * jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), parameters)
        return jnp.sum(dynamics(model.energies(moved)).forward_dynamics(q, qd, tau) * direction)

    difference = (loss(1e-5) - loss(-1e-5)) / 2e-5
    assert float(jax.jit(jax.grad(loss))(0.0)) == pytest.approx(float(difference), rel=1e-6)


def test_scales_divide_what_enters_and_multiply_what_leaves():
    q, rate, x = jax.random.normal(jax.random.key(7), (3, 2))
    scales = (4.0, 0.5)
    for make, name in ((make_black_box_lagrangian, "rate_scale"), (make_black_box_hamiltonian, "momentum_scale")):
        parameters = make(MIXED, **SMALL).init(jax.random.key(0))
        scaled, plain = (make(MIXED, **SMALL, **given).energies(parameters)[0] for given in ({name: scales}, {}))
        got = jax.jit(scaled)(q, rate * jnp.array(scales))
        np.testing.assert_allclose(got, jax.jit(plain)(q, rate), rtol=1e-13)

    sizes = {"rate_scale": 3.0, "acceleration_scale": (2.0, 5.0), "tau_scale": scales}
    parameters = make_feed_forward(MIXED, **SMALL).init(jax.random.key(0))
    scaled, plain = (make_feed_forward(MIXED, **SMALL, **given).energies(parameters) for given in (sizes, {}))
    acceleration, force = jnp.array([2.0, 5.0]), jnp.array(scales)
    got = scaled.inverse_dynamics(q, 3 * rate, acceleration * x)
    np.testing.assert_allclose(got, force * plain.inverse_dynamics(q, rate, x), rtol=1e-13)
    got = scaled.forward_dynamics(q, 3 * rate, force * x)
    np.testing.assert_allclose(got, acceleration * plain.forward_dynamics(q, rate, x), rtol=1e-13)


def test_feed_forward_has_no_energy():
    system = make_feed_forward(MIXED, **SMALL)
    system = dynamics(system.energies(system.init(jax.random.key(0))))
    assert isinstance(system, PlainDynamics)
    q, qd, qdd = jax.random.normal(jax.random.key(8), (3, 2))
    jitted = compiled(system, jnp.float64)
    assert isinstance(jitted, PlainDynamics)
    parts = jitted.decompose(q, qd, qdd)
    rest = jnp.zeros(2)
    tau = system.inverse_dynamics
    np.testing.assert_allclose(parts.gravity, tau(q, rest, rest), rtol=1e-13)
    np.testing.assert_allclose(parts.inertial, tau(q, rest, qdd) - tau(q, rest, rest), rtol=1e-12)
    np.testing.assert_allclose(parts.coriolis, tau(q, qd, rest) - tau(q, rest, rest), rtol=1e-12)
    turned = tau(q + jnp.array([0.0, 2 * jnp.pi]), qd, qdd)
    np.testing.assert_allclose(turned, tau(q, qd, qdd), rtol=1e-12)
    assert np.abs(tau(q + jnp.array([2 * jnp.pi, 0.0]), qd, qdd) - turned).max() > 1e-3


def test_absent_terms_cost_nothing():
    def costs(gravity, friction):
        needs = Needs(("revolute",) * 2, gravity=gravity, friction=friction)
        return flops_and_parameters(make_structured_hamiltonian(needs, **SMALL), "forward_dynamics", 2)

    full, full_parameters = costs(True, True)
    frictionless, frictionless_parameters = costs(True, False)
    weightless, weightless_parameters = costs(False, False)
    assert weightless < 0.9 * frictionless < 0.9 * full
    assert full_parameters - frictionless_parameters == 2
    assert frictionless_parameters - weightless_parameters == 4 * 5 + 5 + 5 + 1


@pytest.mark.parametrize("make", NOMINAL, ids=lambda make: make.__name__)
def test_the_type_of_the_parameters_is_that_of_the_answers(make):
    model = make(MIXED, width=3, depth=1)
    shapes = jax.eval_shape(model.init, jax.random.key(0))
    state = (jax.ShapeDtypeStruct((2,), jnp.float32),) * 3
    assert {leaf.dtype for leaf in jax.tree.leaves(shapes)} == {jnp.dtype(jnp.float32)}
    for name in ("inverse_dynamics", "forward_dynamics"):
        answer = jax.eval_shape(lambda p, *s, name=name: getattr(dynamics(model.energies(p)), name)(*s), shapes, *state)
        assert (answer.shape, answer.dtype) == ((2,), jnp.float32)


def plain_dynamics():
    return dynamics(make_feed_forward(MIXED).energies({}))


def of_mass(diagonal):
    """The dynamics of L = ½ Σ m(q) qd²."""
    return dynamics(LagrangianSystem(lambda q, qd: 0.5 * jnp.sum(diagonal(q) * qd**2)))


def test_definiteness_is_reported():
    for diagonal, expected in [
        (lambda q: jnp.array([1.0, 4.0]), (1.0, 0.0, 4.0)),
        (lambda q: jnp.stack([1.0 + q[1] ** 2, 0.0 * q[1]]), (0.0, 1.0, np.inf)),
        (lambda q: jnp.array([1.0, -2.0]), (-2.0, 1.0, 2.0)),
        (lambda q: jnp.stack([jnp.ones_like(q[0]), q[0]]), (-0.5, 0.25, 2.0)),
        (lambda q: jnp.array([1.0, 1e-17]), (1e-17, 1.0, np.inf)),
    ]:
        q = np.array([[-0.5, 0.0], [0.5, 0.0], [1.0, 0.0], [2.0, 0.0]])
        np.testing.assert_allclose(definiteness(of_mass(diagonal), q, q), expected, rtol=1e-12)


def test_definiteness_of_networks():
    q, qd = np.asarray(jax.random.normal(jax.random.key(0), (2, 50, 2)))
    structured, black_box = (
        dynamics(model.energies(jax.jit(model.init)(jax.random.key(0))))
        for model in (make_structured_hamiltonian(MIXED, **SMALL), make_black_box_lagrangian(MIXED, **SMALL))
    )
    masses = np.asarray(jax.jit(jax.vmap(black_box.mass_matrix))(q, qd))
    eigenvalues = np.linalg.eigvalsh(masses)
    report = definiteness(black_box, q, qd)
    assert report.share_not_definite == np.mean(eigenvalues[:, 0] <= 0) > 0
    assert report.smallest_eigenvalue == pytest.approx(eigenvalues.min())
    assert report.largest_condition_number == pytest.approx(np.linalg.cond(masses).max(), rel=1e-6)
    assert definiteness(structured, q, qd).share_not_definite == 0
    singular = dynamics(HamiltonianSystem(lambda q, p: 0.5 * p[0] ** 2))
    report = definiteness(singular, q, qd)
    assert np.isnan(report.smallest_eigenvalue)
    assert (report.share_not_definite, report.largest_condition_number) == (1.0, np.inf)


def test_wrong_use_raises_one_clear_line():
    for call, message in [
        (lambda: make_black_box_lagrangian(MIXED, rate_scale=(1.0, 2.0, 3.0)), "rate_scale has 3 sizes"),
        (lambda: make_black_box_hamiltonian(MIXED, momentum_scale=0.0), "momentum_scale is 0.0"),
        (lambda: make_black_box_hamiltonian(MIXED, iterations=0), "iterations is 0"),
        (lambda: make_feed_forward(MIXED, tau_scale=(1.0, float("nan"))), "tau_scale is nan"),
        (lambda: make_feed_forward(MIXED, acceleration_scale=(1.0,)), "acceleration_scale has 1 sizes"),
        (lambda: make_structured_hamiltonian(MIXED, width=0), "width is 0"),
        (lambda: make_delan(MIXED, width=-1), "width is -1"),
        (lambda: make_black_box_lagrangian(MIXED, depth=0), "depth is 0"),
        (lambda: definiteness(of_mass(jnp.ones_like), np.zeros((0, 2)), np.zeros((0, 2))), "no states"),
        (
            lambda: definiteness(plain_dynamics(), np.zeros((1, 2)), np.zeros((1, 2))),
            "no mass",
        ),
    ]:
        with pytest.raises(InputError, match=message):
            call()
