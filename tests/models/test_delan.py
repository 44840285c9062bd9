"""The structured model: physics for random parameters, and no work for what a scene lacks."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from costs import flops_and_parameters
from hypothesis import given, settings
from hypothesis import strategies as st

from dln_jax.mechanics import lagrangian
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.lagrangian import make_delan
from dln_jax.models.model import joint_features
from dln_jax.types import Needs


@functools.cache
def small(d, friction=False, gravity=True, prismatic=False, depth=2):
    joints = ("prismatic" if prismatic else "revolute",) * d
    needs = Needs(joints, gravity=gravity, friction=friction)
    return make_delan(needs, width=6, depth=depth, dtype=jnp.float64)


@functools.cache
def checks(d):
    """Mass matrix, residual of inverse after forward, energy rate minus power, structured minus generic torque."""
    model = small(d, depth=1)

    @jax.jit
    def evaluate(seed, q, qd, tau):
        system = dynamics(model.energies(model.init(jax.random.key(seed))))
        qdd = system.forward_dynamics(q, qd, tau)
        again = system.inverse_dynamics(q, qd, qdd)
        rate = jax.jvp(system.energy, (q, qd), (qd, qdd))[1]

        def L(q, qd):
            kinetic = 0.5 * qd @ system.mass_matrix(q) @ qd
            return 2 * kinetic - system.energy(q, qd)

        generic = lagrangian.inverse_dynamics(L, q, qd, qdd)
        total = sum(system.decompose(q, qd, qdd))
        return system.mass_matrix(q), again - tau, rate - qd @ tau, generic - tau, total - tau

    return evaluate


@settings(max_examples=30, deadline=None)
@given(d=st.sampled_from([1, 3]), seed=st.integers(0, 2**16))
def test_physics_holds_for_random_parameters(d, seed):
    state = np.random.default_rng(seed).normal(size=(3, d))
    mass, *residuals = checks(d)(seed, *state)
    np.testing.assert_allclose(mass, mass.T, atol=1e-14)
    assert np.linalg.eigvalsh(mass).min() > 0
    for residual in residuals:
        assert np.abs(residual).max() < 1e-10


def test_dissipation_takes_power_away():
    model = small(2, friction=True, depth=1)
    q, qd = jnp.array([[0.3, -0.7], [1.0, 2.0]])

    @jax.jit
    def power():
        parameters = model.init(jax.random.key(0))
        system = dynamics(model.energies(parameters))
        qdd = system.forward_dynamics(q, qd, jnp.zeros(2))
        coefficients = jax.nn.softplus(next(iter(parameters["~"].values())))
        return jax.jvp(system.energy, (q, qd), (qd, qdd))[1], -coefficients @ qd**2

    rate, dissipated = power()
    assert float(rate) == pytest.approx(float(dissipated), rel=1e-10)
    assert float(rate) < 0


def test_absent_terms_cost_nothing():
    full, full_parameters = flops_and_parameters(small(3, friction=True), "inverse_dynamics", 3)
    frictionless, frictionless_parameters = flops_and_parameters(small(3), "inverse_dynamics", 3)
    weightless, weightless_parameters = flops_and_parameters(small(3, gravity=False), "inverse_dynamics", 3)
    assert weightless < 0.75 * frictionless < 0.75 * full
    potential = 6 * 6 + 6 + 6 * 6 + 6 + 6 + 1
    assert full_parameters - frictionless_parameters == 3
    assert frictionless_parameters - weightless_parameters == potential


def test_prismatic_joints_take_no_trigonometry():
    def text(**kinds):
        model = small(2, **kinds)
        parameters = jax.tree.map(lambda leaf: np.zeros(leaf.shape), jax.eval_shape(model.init, jax.random.key(0)))
        return str(jax.make_jaxpr(dynamics(model.energies(parameters)).mass_matrix)(jnp.zeros(2)))

    assert " cos" in text() and " sin" in text()
    assert " cos" not in text(prismatic=True) and " sin" not in text(prismatic=True)
    mixed = joint_features(Needs(("prismatic", "revolute")), jnp.array([2.0, 0.0]))
    np.testing.assert_array_equal(mixed, [1.0, 0.0, 2.0])


def test_a_full_turn_changes_nothing():
    model = small(2)
    q, qd, qdd = np.array([[0.4, 1.0], [1.0, -1.0], [0.5, 2.0]])

    @jax.jit
    def torque(q):
        return dynamics(model.energies(model.init(jax.random.key(1)))).inverse_dynamics(q, qd, qdd)

    for turns in (1.0, 1000.0):
        np.testing.assert_allclose(torque(q), torque(q + 2 * np.pi * np.array([turns, -turns])), rtol=turns * 1e-11)


def test_single_precision_and_nan():
    """float32 loses no more than its rounding, and NaN in a state never becomes a finite answer."""
    model = small(2)
    parameters = jax.jit(model.init)(jax.random.key(1))
    narrow = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), parameters)
    q, qd, x = np.array([[0.4, 1.0], [1.0, -1.0], [0.5, 2.0]], np.float32)

    @jax.jit
    def answers(parameters, *state):
        system = dynamics(model.energies(parameters))
        return jnp.stack([system.inverse_dynamics(*state), system.forward_dynamics(*state)])

    single = answers(narrow, q, qd, x)
    assert single.dtype == jnp.float32
    exact = answers(parameters, *(array.astype(np.float64) for array in (q, qd, x)))
    np.testing.assert_allclose(single, exact, rtol=1e-4, atol=1e-5)
    for place in range(3):
        state = [array.copy() for array in (q, qd, x)]
        state[place][0] = np.nan
        assert not np.isfinite(answers(narrow, *state)).all(axis=1).any()


@pytest.mark.slow
def test_the_forward_model_is_a_diffrax_vector_field():
    model = small(2)
    system = dynamics(model.energies(model.init(jax.random.key(2))))

    def field(t, state, args):
        q, qd = state
        return qd, system.forward_dynamics(q, qd, jnp.zeros_like(q))

    start = (jnp.array([0.5, -0.2]), jnp.zeros(2))
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        diffrax.Dopri8(),
        t0=0.0,
        t1=2.0,
        dt0=None,
        y0=start,
        saveat=diffrax.SaveAt(ts=jnp.linspace(0, 2, 9)),
        stepsize_controller=diffrax.PIDController(rtol=1e-10, atol=1e-10),
    )
    energies = jax.jit(jax.vmap(system.energy))(*solution.ys)
    assert np.abs(energies - energies[0]).max() < 1e-8
    assert np.abs(solution.ys[0][-1] - start[0]).max() > 1e-2
