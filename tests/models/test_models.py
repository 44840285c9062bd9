"""Models of every kind obey mechanics for random parameters; scales, types and reports of networks."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from conftest import slow_among

from dln_jax.mechanics import hamiltonian, lagrangian
from dln_jax.mechanics.dynamics import InverseForward
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.metrics.errors import definiteness
from dln_jax.models.baselines import make_feed_forward
from dln_jax.models.hamiltonian import (
    make_black_box_hamiltonian,
    make_separable_hamiltonian,
    make_structured_hamiltonian,
)
from dln_jax.models.model import make_black_box_lagrangian, make_delan
from dln_jax.types import Needs
from dln_jax.zoo.descriptions import build, describe
from tests.models.random_parameters import drawn

MIXED = Needs(("prismatic", "revolute"), friction=True)
SIZE = {"width": 5, "depth": 1}
SMALL = {**SIZE, "dtype": jnp.float64}


KINDS = {
    "structured-delan": SIZE,
    "structured-hnn": SIZE,
    "black-box-delan": SIZE | {"activation": "softplus"},
    "planar-chain": {"symmetric": False},
    "learned-tree": {},
    "trigonometric": {"degree": [1, 2]},
    "trigonometric-kernel": {"samples": 3},
}
DEFINITE = ("structured-delan", "structured-hnn")


@pytest.mark.parametrize("kind", slow_among(KINDS, lambda kind: kind in ("trigonometric-kernel", "learned-tree")))
def test_mechanics_holds_for_random_parameters(kind):
    """Inverse after forward, the parts and friction, the power balance; Euler-Lagrange where T is quadratic."""
    model = build(describe(kind, needs=MIXED, precision="f64", **KINDS[kind]))
    parameters = drawn(model)

    @jax.jit
    @jax.vmap
    def residuals(q, qd, tau):
        system = dynamics(model.energies(parameters))
        qdd = system.forward_dynamics(q, qd, tau)
        force = tau - system.friction(q, qd)
        rate = jax.jvp(system.energy, (q, qd), (qd, qdd))[1]
        M = system.mass_matrix(q, qd)

        def L(q, qd):
            return qd @ system.mass_matrix(q, qd) @ qd - system.energy(q, qd)

        differences = [system.inverse_dynamics(q, qd, qdd) - tau]
        if kind != "black-box-delan":
            differences += [
                sum(system.decompose(q, qd, qdd)) - force,
                lagrangian.inverse_dynamics(L, q, qd, qdd) - force,
            ]
        scale = 1 + jnp.abs(M).max() * jnp.abs(qdd).max()
        return jnp.stack(differences) / scale, (rate - qd @ force) / scale, M, system.friction(q, qd)

    q, qd, tau = np.random.default_rng(1).normal(size=(3, 10, 2))
    forces, power, M, friction = residuals(q, qd, tau)
    np.testing.assert_allclose(forces, 0, atol=1e-11)
    np.testing.assert_allclose(power, 0, atol=1e-11)
    np.testing.assert_allclose(M, M.swapaxes(1, 2), rtol=1e-13)
    assert (np.sum(friction * qd, axis=1) != 0).all()
    if "~" in parameters:
        np.testing.assert_allclose(friction, jax.nn.softplus(parameters["~"]["viscous_friction"]) * qd, rtol=1e-13)
    if kind in DEFINITE:
        assert np.linalg.eigvalsh(M).min() > 0


def test_black_box_hamiltonian_follows_its_energy():
    """At velocities that the network has a momentum for; its parameters' gradient against differences."""
    p = jnp.array([0.6])
    needs = Needs(("revolute",), friction=True)
    model = make_black_box_hamiltonian(needs, initial_guess=lambda q, qd: p + 0.01, **SMALL)
    q, tau, direction = jnp.asarray(np.random.default_rng(5).normal(size=(3, 1)))
    parameters = jax.jit(model.init)(jax.random.key(1))
    H = flow(model.energies(parameters)).energy
    qd = hamiltonian.velocity(H, q, p)

    @jax.jit
    def evaluate(step):
        moved = jax.tree.map(lambda leaf: leaf + step * jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), parameters)
        system = dynamics(model.energies(moved))
        qdd = system.forward_dynamics(q, qd, tau)
        energy, rate = jax.jvp(system.energy, (q, qd), (qd, qdd))
        power = qd @ (tau - system.friction(q, qd))
        return qdd @ direction, (energy - H(q, p), system.inverse_dynamics(q, qd, qdd) - tau, rate - power)

    (_, residuals), slope = jax.jit(jax.value_and_grad(evaluate, has_aux=True))(0.0)
    for residual in residuals:
        np.testing.assert_allclose(residual, 0, atol=1e-9)
    assert float(slope) == pytest.approx(float(evaluate(1e-5)[0] - evaluate(-1e-5)[0]) / 2e-5, rel=1e-6)


def test_scales_divide_what_enters_and_multiply_what_leaves():
    q, rate, x = jax.random.normal(jax.random.key(7), (3, 2))
    scales = (4.0, 0.5)
    for make, name in (
        (make_black_box_lagrangian, "rate_scale"),
        (make_black_box_hamiltonian, "momentum_scale"),
        (make_separable_hamiltonian, "momentum_scale"),
    ):
        parameters = drawn(make(MIXED, **SMALL))
        scaled, plain = (make(MIXED, **SMALL, **given).energies(parameters)[0] for given in ({name: scales}, {}))
        np.testing.assert_allclose(scaled(q, rate * jnp.array(scales)), plain(q, rate), rtol=1e-13)

    sizes = {"rate_scale": 3.0, "acceleration_scale": (2.0, 5.0), "tau_scale": scales}
    parameters = drawn(make_feed_forward(MIXED, **SMALL))
    scaled, plain = (make_feed_forward(MIXED, **SMALL, **given).energies(parameters) for given in (sizes, {}))
    acceleration, force = jnp.array([2.0, 5.0]), jnp.array(scales)
    got = scaled.inverse_dynamics(q, 3 * rate, acceleration * x)
    np.testing.assert_allclose(got, force * plain.inverse_dynamics(q, rate, x), rtol=1e-13)
    got = scaled.forward_dynamics(q, 3 * rate, force * x)
    np.testing.assert_allclose(got, acceleration * plain.forward_dynamics(q, rate, x), rtol=1e-13)


def test_feed_forward_has_no_energy():
    model = make_feed_forward(MIXED, **SMALL)
    system = dynamics(model.energies(drawn(model)))
    assert isinstance(system, InverseForward)
    q, qd, qdd = jax.random.normal(jax.random.key(8), (3, 2))
    parts, rest, tau = system.decompose(q, qd, qdd), jnp.zeros(2), system.inverse_dynamics
    gravity = tau(q, rest, rest)
    expected = tau(q, rest, qdd) - gravity, tau(q, qd, rest) - gravity, gravity
    np.testing.assert_allclose(parts, expected, rtol=1e-12)
    for turn, same in (([0.0, 2 * np.pi], True), ([2 * np.pi, 0.0], False)):
        assert np.allclose(tau(q + np.array(turn), qd, qdd), tau(q, qd, qdd), rtol=1e-12, atol=0) == same


def test_the_type_of_the_parameters_is_that_of_the_answers():
    def answers(model, parameters, *state):
        system = dynamics(model.energies(parameters))
        return system.inverse_dynamics(*state), system.forward_dynamics(*state)

    state = (jax.ShapeDtypeStruct((2,), jnp.float32),) * 3
    for make in (make_structured_hamiltonian, make_black_box_hamiltonian, make_black_box_lagrangian, make_feed_forward):
        model = make(MIXED, width=3, depth=1)
        shapes = jax.eval_shape(model.init, jax.random.key(0))
        found = jax.eval_shape(functools.partial(answers, model), shapes, *state)
        assert {leaf.dtype for leaf in jax.tree.leaves((shapes, found))} == {jnp.dtype(jnp.float32)}


def of_mass(diagonal):
    """The dynamics of L = ½ Σ m(q) qd²."""
    return dynamics(LagrangianSystem(lambda q, qd: 0.5 * jnp.sum(diagonal(q) * qd**2)))


def test_definiteness_is_reported():
    for diagonal, expected in [
        (lambda q: jnp.stack([1.0 + q[1] ** 2, 0.0 * q[1]]), (0.0, 1.0, np.inf)),
        (lambda q: jnp.array([1.0, -2.0]), (-2.0, 1.0, 2.0)),
        (lambda q: jnp.stack([jnp.ones_like(q[0]), q[0]]), (-0.5, 0.25, 2.0)),
        (lambda q: jnp.array([1.0, 1e-17]), (1e-17, 1.0, np.inf)),
    ]:
        q = np.array([[-0.5, 0.0], [0.5, 0.0], [1.0, 0.0], [2.0, 0.0]])
        np.testing.assert_allclose(definiteness(of_mass(diagonal), q, q), expected, rtol=1e-12)


def test_wrong_use_raises_one_clear_line():
    for call, message in [
        (lambda: make_black_box_lagrangian(MIXED, rate_scale=(1.0, 2.0, 3.0)), "rate_scale has 3 sizes"),
        (lambda: make_black_box_hamiltonian(MIXED, momentum_scale=0.0), "momentum_scale is 0.0"),
        (lambda: make_feed_forward(MIXED, tau_scale=(1.0, float("nan"))), "tau_scale is nan"),
        (lambda: make_feed_forward(MIXED, acceleration_scale=(1.0,)), "acceleration_scale has 1 sizes"),
        (lambda: make_delan(MIXED, width=-1), "width is -1"),
        (lambda: definiteness(of_mass(jnp.ones_like), *np.zeros((2, 0, 2))), "no states"),
        (lambda: definiteness(dynamics(make_feed_forward(MIXED).energies({})), *np.zeros((2, 1, 2))), "no mass"),
    ]:
        with one_line(message):
            call()
