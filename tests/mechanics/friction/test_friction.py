"""Friction of joints: its force, that it takes power, and its slope where a joint rests."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.mechanics import jacobians
from dln_jax.mechanics.closed_form import ClosedForm
from dln_jax.mechanics.dynamics import friction_force
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.scenes import two_link_arm
from dln_jax.types import InputError

B, C, OFFSET, SCALE = np.array([0.2, 0.1]), np.array([0.5, 0.3]), np.array([-0.05, 0.02]), 0.02
VELOCITIES = np.array([[0.0, 0.0], [1e-9, -1e-9], [0.01, -0.02], [3.0, -2.0], [1e4, -1e5]])


@pytest.mark.parametrize("qd", VELOCITIES, ids=str)
def test_the_force_is_the_formula(qd):
    force = friction_force(joint_dissipation(B, C, OFFSET, velocity_scale=SCALE), jnp.zeros(2), jnp.asarray(qd))
    np.testing.assert_allclose(force, B * qd + C * np.tanh(qd / SCALE) + OFFSET, rtol=1e-14)


def test_the_function_is_the_integral_of_the_force_and_takes_power():
    D = joint_dissipation(B, C, velocity_scale=SCALE)
    qd = np.linspace(-2, 2, 2001)
    values = np.array(jax.vmap(lambda v: D(jnp.zeros(2), jnp.array([v, 0.0])))(qd))
    np.testing.assert_allclose(values, 0.5 * B[0] * qd**2 + C[0] * SCALE * np.log(np.cosh(qd / SCALE)), atol=1e-15)
    power = np.array(jax.vmap(lambda v: v @ friction_force(D, jnp.zeros(2), v))(VELOCITIES))
    assert (power >= 0).all() and power[0] == 0


def test_a_joint_at_rest_has_the_slope_of_its_scale():
    arm = two_link_arm()
    dissipation = joint_dissipation(B, C, velocity_scale=SCALE)
    system = LagrangianSystem(arm.lagrangian, dissipation)
    zero = jnp.zeros(2)
    _, by_velocity, _ = jacobians.inverse_dynamics_jacobians(system, zero, zero, zero)
    np.testing.assert_allclose(by_velocity, np.diag(B + C / SCALE), rtol=1e-12, atol=1e-12)


def test_what_is_not_needed_is_not_there():
    assert joint_dissipation() is None and joint_dissipation(np.zeros(3), 0.0) is None
    text = str(jax.make_jaxpr(joint_dissipation(B))(jnp.zeros(2), jnp.zeros(2)))
    assert "log" not in text
    known = two_link_arm().closed_form
    assert isinstance(known, ClosedForm) and dynamics(known).friction([0.1, 0.2], [1.0, 2.0]).tolist() == [0, 0]


def test_coefficients_may_be_learned():
    def power(c):
        return joint_dissipation(0.0, c, velocity_scale=SCALE)(jnp.zeros(2), jnp.array([1.0, -2.0]))

    slope = jax.jit(jax.grad(power))(jnp.asarray(C))
    np.testing.assert_allclose(slope, SCALE * np.log(np.cosh(np.array([1.0, 2.0]) / SCALE)), rtol=1e-12)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"viscous": -0.1}, "viscous is -0.1; expected finite numbers, none of them negative"),
        ({"coulomb": [0.1, np.nan]}, "coulomb is"),
        ({"offset": np.inf}, "offset is inf; expected finite numbers$"),
        ({"coulomb": 0.1, "velocity_scale": 0.0}, "velocity_scale is 0.0; expected a positive number"),
    ],
)
def test_what_is_no_friction_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        joint_dissipation(**options)
