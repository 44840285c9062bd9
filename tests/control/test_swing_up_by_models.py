"""A swing-up takes any model that it can use, and says in one line why it cannot use another."""

import jax
import jax.numpy as jnp
import numpy as np
from calls import one_line
from furuta import HARDWARE, LAYOUT, NOMINAL, TRUTH
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax.control.closed_loop import hanging_starts, outcomes, simulate
from dln_jax.control.estimate.kalman import mechanical
from dln_jax.control.observers import by_differences, by_filter
from dln_jax.control.regulators import lqr
from dln_jax.control.state_space import field_of
from dln_jax.control.swing_up import USUAL, law_of, nearest_equilibrium, swing_up_numbers, upright_of
from dln_jax.mechanics.dynamics import InverseForward
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.scenes.pendulums import rotary_pendulum


def with_potential(extra):
    """The nominal model with another energy added."""
    L = rotary_pendulum().lagrangian
    return dynamics(LagrangianSystem(lambda q, qd: L(q, qd) - extra(q)))


def test_dry_friction_holds_no_pole_down():
    upright = upright_of(TRUTH, LAYOUT)
    # The regulator whose gains the bound on the torques was measured with.
    regulator = lqr(upright.at.A, upright.at.B, np.diag([1.0, 1.0, 0.01, 0.01]), np.array([[50.0]]))
    numbers = swing_up_numbers(upright, {**USUAL, "energy": 10.0})._replace(regulator=regulator, level=0.07)
    law = law_of(upright, numbers)
    field = field_of(TRUTH, LAYOUT.actuation)
    settings = {"seconds": 4.0, "rate": LAYOUT.rate, "controls": 1, "hardware": HARDWARE, "substeps": 2}

    def tried(estimator):
        run = jax.vmap(lambda x, key: simulate(field, estimator(law), x, key=key, **settings))
        found = jax.jit(run)(hanging_starts(8, 5, position=0.1), jax.random.split(jax.random.key(5), 8))
        assert outcomes(found.x[..., 1], rate=LAYOUT.rate).share == 1
        return np.median(np.sqrt(np.mean(found.u[:, -500:] ** 2, axis=(1, 2))))

    # A filter that knows the plant's own noise holds it with less torque than differences.
    noise = {"band": [2.5e-4, 1e-5], "encoder_step": HARDWARE.encoder_step}
    process = mechanical(TRUTH, LAYOUT.actuation, rate=LAYOUT.rate, **noise)
    assert tried(by_filter(LAYOUT, process, delay=1)) < 0.3 * tried(by_differences(LAYOUT))
    # Exactly at rest, where the energy law asks for nothing.
    law = jax.jit(law)
    assert_allclose(jnp.abs(law(jnp.array([0.0, np.pi, 0.0, 0.0]))[0]), numbers.kick)
    for place in range(4):
        assert np.isnan(law(jnp.array([0.1, 3.0, 0.2, 0.3]).at[place].set(jnp.nan))).all()


def test_the_model_s_own_equilibrium_is_found():
    tilted = with_potential(lambda q: 1e-3 * q[1])
    weight = 0.024 * 9.81 * 0.129 / 2
    home = nearest_equilibrium(tilted, np.zeros(2), (1,))
    assert_allclose(home, [0.0, np.arcsin(1e-3 / weight)], atol=1e-10)


def test_models_that_cannot_be_used_are_refused():
    indefinite = LagrangianSystem(lambda q, qd: 0.5 * qd[0] ** 2 - 0.5 * qd[1] ** 2)
    for model, message in (
        (InverseForward(*NOMINAL[:2]), "has no energy"),
        (dynamics(indefinite), "not positive definite"),
        (with_potential(lambda q: 0.1 * q[1]), "no equilibrium near the goal"),
        (with_potential(lambda q: 0.2 * q[0]), "outside the limits"),  # the motor is too weak
    ):
        with one_line(message):
            upright_of(model, LAYOUT)


def test_runs_that_are_not_finite_are_failures_and_counted():
    angle = np.array([[3.1, 0.2, 0.05, 0.05], [3.1, 0.05, np.nan, np.nan], [0.0, 0.0, 0.0, 0.0], [3.1, 0.0, 0.0, 0.3]])
    found = outcomes(angle, rate=10.0)
    assert_allclose(found.seconds, [0.2, np.inf, 0.0, np.inf])
    assert_array_equal(found.failed, [False, True, False, False])
    assert found.share == 0.5 and found.worst == 0.2
    assert outcomes(angle + 2 * np.pi, rate=10.0).share == 0.5
